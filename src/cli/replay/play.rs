//! A session's machines as peers of a site.

use std::collections::BTreeMap;
use std::error::Error;
use std::time::Instant;

use super::super::progress::{Progress, Unit};
use super::super::{Outcome, logging, machine::shutdown_signal};
use super::{Session, lost};
use crate::config::{self, Machine};
use crate::player::{self, Options, Part, Progress as Played};
use crate::record::{Said, read_said};

/// Where it is played to.
pub(super) struct Site {
    pub(super) endpoint: String,
    pub(super) id: Option<String>,
    pub(super) machine_files: BTreeMap<String, Machine>,
}

/// Plays the session until its end or a signal.
pub(super) fn run(session: &Session, site: &Site, speed: f64) -> Result<Outcome, Box<dyn Error>> {
    logging::start();
    let mut bar = Progress::new("reading", Unit::Bytes);
    let mut machines = Vec::new();
    let mut lost_bytes = 0;
    let all_bytes = session.bytes * session.machines.len() as u64;
    for (index, id) in (0..).zip(&session.machines) {
        let said = read_said(session.paths(), id, |bytes| {
            bar.show((index * session.bytes + bytes) as f64, all_bytes as f64);
        })?;
        lost_bytes = said.lost_bytes;
        let site = site_of(site, id, &said)?;
        machines.push(Part { id: id.clone(), site, messages: said.messages });
    }
    bar.finish();
    let begun = Instant::now();
    let mut bar = Progress::new("playing", Unit::DataSeconds);
    let tell = |progress: Played| bar.show(progress.data_s, progress.length_s);
    let options = Options { machines, endpoint: site.endpoint.clone(), speed };
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    let played = runtime.block_on(async {
        let shutdown = shutdown_signal()?;
        Ok::<_, Box<dyn Error>>(player::play(options, tell, shutdown).await?)
    })?;
    bar.finish();
    println!(
        "{}: {} messages, {:.1} s, in {:.1} s",
        session.machines.join(", "),
        played.sent,
        played.data_s,
        begun.elapsed().as_secs_f64()
    );
    if lost_bytes > 0 {
        eprintln!("{}", lost(lost_bytes));
    }
    if played.unsent > 0 {
        eprintln!("{} messages could not be sent", played.unsent);
    }
    Ok(match played {
        Played { interrupted: true, .. } => Outcome::Interrupted,
        Played { unsent, .. } if unsent + lost_bytes > 0 => Outcome::DataWasBad,
        _ => Outcome::Done,
    })
}

/// The id of the site: what is asked for, or what the machine was configured for.
fn site_of(site: &Site, id: &str, said: &Said) -> Result<String, Box<dyn Error>> {
    if let Some(wanted) = &site.id {
        return Ok(wanted.clone());
    }
    if let Some(machine) = site.machine_files.get(id) {
        return Ok(machine.link.site.clone());
    }
    Ok(match said.machine_file() {
        Some(text) => {
            let path = format!("machine file of {id} in the recording");
            config::parse::<Machine>(&text, path.as_ref())?.link.site
        }
        None => config::Link::default().site,
    })
}
