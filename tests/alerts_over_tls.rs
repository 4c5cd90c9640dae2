//! Receivers behind TLS: told if somebody we believe has signed their certificates for their names, and only then.
#![cfg(feature = "shells")]

#[path = "support/receivers.rs"]
#[allow(dead_code, reason = "shared with tests that use more of it")]
mod receivers;
#[path = "support/site.rs"]
#[allow(dead_code, reason = "shared with tests that use more of it")]
mod support;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use holdfast::config;
use holdfast::site::Site;
use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair};
use serde_json::Value;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::ServerConfig;
use tokio_rustls::rustls::pki_types::PrivatePkcs8KeyDer;

use receivers::{HttpReceiver, MailReceiver, Secrecy};
use support::{Folder, exchange};

/// A company's own authority.
struct Authority {
    issuer: Issuer<'static, KeyPair>,
    file: PathBuf,
}

impl Authority {
    fn new(folder: &Folder) -> Self {
        let mut parameters = CertificateParams::new(Vec::new()).expect("parameters");
        parameters.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let key = KeyPair::generate().expect("a key");
        let certificate = parameters.self_signed(&key).expect("signed");
        let file = folder.0.join("authority.pem");
        std::fs::write(&file, certificate.pem()).expect("written");
        Self { issuer: Issuer::new(parameters, key), file }
    }

    /// A server's side, with a certificate for that name.
    fn acceptor(&self, name: &str) -> TlsAcceptor {
        let key = KeyPair::generate().expect("a key");
        let parameters = CertificateParams::new(vec![name.to_owned()]).expect("parameters");
        let certificate = parameters.signed_by(&key, &self.issuer).expect("signed");
        let provider = Arc::new(tokio_rustls::rustls::crypto::ring::default_provider());
        let config = ServerConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .expect("versions")
            .with_no_client_auth()
            .with_single_cert(
                vec![certificate.der().clone()],
                PrivatePkcs8KeyDer::from(key.serialize_der()).into(),
            )
            .expect("a certificate");
        TlsAcceptor::from(Arc::new(config))
    }
}

fn config(folder: &Folder, alerts: &str) -> config::Site {
    let mut text = toml::to_string(&folder.config()).expect("TOML");
    let tables = text.find("\n[alerts").expect("all tables are written");
    text.truncate(tables);
    text.push_str(&format!("\n[alerts]\n{alerts}"));
    config::parse(&text, Path::new("site.toml")).unwrap_or_else(|error| panic!("{error}\n{text}"))
}

/// Whether each channel was told, and what it said.
async fn tell(config: &config::Site) -> Vec<(bool, String)> {
    let site = Site::start(config).await.expect("starts");
    let said = exchange(site.address(), "POST", "/api/v1/alerts/test", &[]).await.json();
    site.stop().await;
    let channel =
        |channel: &Value| (channel["delivered"] == true, channel["said"].as_str().expect("words").to_owned());
    said["channels"].as_array().expect("channels").iter().map(channel).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn webhooks_and_mail_over_tls_reach_those_whom_a_believed_authority_has_signed() {
    let folder = Folder::new("alerts-tls");
    let authority = Authority::new(&folder);
    let (ours, other) = (authority.acceptor("127.0.0.1"), authority.acceptor("elsewhere.example"));
    let hook = HttpReceiver::start_over(Secrecy::Tls(ours.clone()), "127.0.0.1:0", &[]).await;
    let impostor = HttpReceiver::start_over(Secrecy::Tls(other), "127.0.0.1:0", &[]).await;
    let hooks = format!(
        "[[alerts.webhook]]\nname = \"ours\"\nurl = \"https://{}/\"\n\
         [[alerts.webhook]]\nname = \"impostor\"\nurl = \"https://{}/\"\n",
        hook.address, impostor.address
    );
    let mail_table = |mail: &MailReceiver, tls: &str| {
        format!(
            "[alerts.mail]\nhost = \"127.0.0.1\"\nport = {}\ntls = {tls:?}\nfrom = \"site@example.com\"\n\
             to = [\"ana@example.com\"]\n",
            mail.address.port()
        )
    };
    let believed = format!("certificates_file = {:?}\n", authority.file);

    let mail = MailReceiver::start_over(Secrecy::Tls(ours.clone())).await;
    let said = tell(&config(&folder, &format!("{believed}{hooks}{}", mail_table(&mail, "tls")))).await;
    assert_eq!(said[0], (true, "204 No Content".to_owned()));
    assert!(!said[1].0 && said[1].1.starts_with("TLS: "), "{said:?}");
    assert_eq!(said[2], (true, "250 taken".to_owned()));
    assert_eq!((hook.requests().len(), impostor.requests().len(), mail.mails().len()), (1, 0, 1));

    let later = MailReceiver::start_over(Secrecy::StartTls(ours.clone())).await;
    let said = tell(&config(&folder, &format!("{believed}{}", mail_table(&later, "starttls")))).await;
    assert_eq!((said, later.mails().len()), (vec![(true, "250 taken".to_owned())], 1));

    // A server that keeps nothing secret is told nothing, and neither is one that a stranger has signed.
    let plain = MailReceiver::start().await;
    let said = tell(&config(&folder, &format!("{believed}{}", mail_table(&plain, "starttls")))).await;
    assert!(!said[0].0 && plain.mails().is_empty(), "{said:?}");
    let said = tell(&config(&folder, &format!("{hooks}{}", mail_table(&mail, "tls")))).await;
    assert!(said.iter().all(|(delivered, _)| !delivered), "{said:?}");
    assert_eq!((hook.requests().len(), mail.mails().len()), (1, 1));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn file_without_an_authority_is_refused_at_the_start() {
    let folder = Folder::new("alerts-no-authority");
    let file = folder.0.join("authority.pem");
    for (text, why) in [(None, "cannot be read"), (Some("nothing\n"), "holds no certificate")] {
        if let Some(text) = text {
            std::fs::write(&file, text).expect("written");
        }
        let config = config(&folder, &format!("certificates_file = {file:?}\n"));
        let message = Site::start(&config).await.err().expect("refused").to_string();
        assert!(message.contains("alerts.certificates_file") && message.contains(why), "{message}");
    }
}
