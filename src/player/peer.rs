//! One machine's session, and what it declares.

use std::collections::BTreeMap;

use zenoh::Wait as _;
use zenoh::bytes::Encoding;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::Queryable;

use super::Part;
use crate::config;
use crate::link::{self, LinkError};
use crate::record::Recorded;
use crate::wire::{
    Attachment, BootId, Holdings, Kept, RecordRequest, Topic, alive_key, encode_json, payload_stamp,
    record_key, topic_key,
};

/// A machine of a recording, connected.
pub(super) struct Peer {
    id: String,
    site: String,
    session: zenoh::Session,
    publishers: BTreeMap<Topic, Publisher<'static>>,
    /// The boot that speaks.
    boot: Option<Boot>,
}

struct Boot {
    /// As it was recorded.
    recorded: Option<BootId>,
    /// Its new id.
    id: BootId,
    token: LivelinessToken,
    record: Queryable<()>,
}

impl Peer {
    /// Opens the session; does not wait for anybody to answer.
    pub(super) async fn open(part: &Part, endpoint: &str) -> Result<Self, LinkError> {
        let dialled = config::Link { connect: vec![endpoint.to_owned()], ..config::Link::default() };
        let session = link::open(link::machine_config(&dialled)?).await?;
        let Part { id, site, .. } = part;
        let mut publishers = BTreeMap::new();
        for topic in Topic::ALL {
            let key = topic_key(site, id, topic);
            let encoding =
                if topic.is_json() { Encoding::APPLICATION_JSON } else { Encoding::APPLICATION_CDR };
            // Of one priority, so that all stays in order; a site that does not keep up is waited for.
            let publisher = session
                .declare_publisher(key.clone())
                .congestion_control(CongestionControl::Block)
                .priority(Priority::Data)
                .encoding(encoding)
                .await
                .map_err(|error| LinkError::Declare { key, reason: link::reason(&error) })?;
            publishers.insert(topic, publisher);
        }
        Ok(Self { id: id.clone(), site: site.clone(), session, publishers, boot: None })
    }

    /// Says for a boot that it has no record of its own.
    async fn declare_record(&self, boot: BootId) -> Result<Queryable<()>, LinkError> {
        let key = record_key(&self.site, &self.id, boot);
        self.session
            .declare_queryable(key.clone())
            .callback(|query| {
                let payload = query.payload().map(|payload| payload.to_bytes()).unwrap_or_default();
                let nothing = Holdings { kept: Kept::No, boots: vec![] };
                let answer = match RecordRequest::decode(&payload) {
                    Ok(RecordRequest::Holdings) => encode_json("holdings", &nothing).ok(),
                    _ => None,
                };
                let answered = match answer {
                    Some(answer) => query.reply(query.key_expr().clone(), answer).wait(),
                    None => query.reply_err("this machine is replayed, and has no record").wait(),
                };
                if let Err(error) = answered {
                    tracing::debug!(%error, "a question about the record could not be answered");
                }
            })
            .await
            .map_err(|error| LinkError::Declare { key, reason: link::reason(&error) })
    }

    /// Waits until somebody listens.
    pub(super) async fn heard(&self, look_every: std::time::Duration) {
        while !self.is_heard().await {
            tokio::time::sleep(look_every).await;
        }
    }

    /// Whether somebody listens.
    pub(super) async fn is_heard(&self) -> bool {
        let Some(publisher) = self.publishers.get(&Topic::Pose) else { return false };
        publisher.matching_status().await.is_ok_and(|status| status.matching())
    }

    /// Says a message again; false if it could not be sent.
    pub(super) async fn say(&mut self, message: Recorded<Vec<u8>>) -> Result<bool, LinkError> {
        let Recorded { topic, boot: recorded, sequence, sent, mut payload, .. } = message;
        let boot = match &self.boot {
            Some(boot) if boot.recorded == recorded => boot.id,
            _ => self.begin_boot(recorded).await?,
        };
        if let (true, Some(recorded)) = (topic.is_json(), recorded) {
            payload = renamed(payload, recorded, boot);
        }
        let stamp = payload_stamp(topic, &payload).unwrap_or(sent);
        let attachment = Attachment { sequence, boot, stamp, sent }.encode();
        let Some(publisher) = self.publishers.get(&topic) else { return Ok(false) };
        let put = publisher.put(payload).attachment(attachment.as_slice()).await;
        if let Err(error) = &put {
            tracing::debug!(%error, %topic, "a message could not be sent");
        }
        Ok(put.is_ok())
    }

    async fn begin_boot(&mut self, recorded: Option<BootId>) -> Result<BootId, LinkError> {
        self.end_boot().await;
        let id = BootId(random());
        let record = self.declare_record(id).await?;
        let key = alive_key(&self.site, &self.id, id);
        let token = self.session.liveliness().declare_token(key.clone()).await;
        let token = token.map_err(|error| LinkError::Declare { key, reason: link::reason(&error) })?;
        self.boot = Some(Boot { recorded, id, token, record });
        Ok(id)
    }

    /// The machine is off until it speaks again.
    pub(super) async fn end_boot(&mut self) {
        let Some(Boot { token, record, .. }) = self.boot.take() else { return };
        if let Err(error) = token.undeclare().await {
            tracing::warn!(%error, "the liveliness token could not be taken back");
        }
        if let Err(error) = record.undeclare().await {
            tracing::warn!(%error, "the queryable of the record could not be taken back");
        }
    }

    /// Takes everything back.
    pub(super) async fn close(mut self) {
        self.end_boot().await;
        drop(self.publishers);
        link::close(self.session).await;
    }
}

/// Reports and pages of the journal name their boot.
fn renamed(payload: Vec<u8>, recorded: BootId, boot: BootId) -> Vec<u8> {
    match String::from_utf8(payload) {
        Ok(text) => {
            let told = |boot| format!("\"boot\":\"{boot}\"");
            text.replacen(&told(recorded), &told(boot), 1).into_bytes()
        }
        Err(error) => error.into_bytes(),
    }
}

/// Differs from run to run; the standard library's hasher is seeded by the system.
fn random() -> u64 {
    use std::hash::{BuildHasher, Hasher};
    std::hash::RandomState::new().build_hasher().finish()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::{JournalPage, decode_journal_page};

    #[test]
    fn page_of_a_replayed_boot_names_the_new_one() {
        let page = encode_json("journal page", &JournalPage::new(BootId(0xab), 3, 1)).expect("JSON");
        let renamed = renamed(page, BootId(0xab), BootId(0xcd));
        assert_eq!(decode_journal_page(&renamed).expect("a page"), JournalPage::new(BootId(0xcd), 3, 1));
        assert_ne!(random(), random());
    }
}
