//! Tells people by e-mail: over SMTP, to the server that the site file names.

use lettre::message::{Mailbox, header::ContentType};
use lettre::transport::smtp::authentication::Credentials;
use lettre::transport::smtp::client::Tls;
use lettre::{AsyncSmtpTransport, AsyncTransport as _, Message, Tokio1Executor};

use super::authorities::Authorities;
use super::{Letter, PATIENCE, secret};
use crate::config::{self, MailTls, Violation};
use crate::fleet::{AlertState, UtcTime};

/// The server, and who is told.
pub(in crate::site) struct Mailer {
    transport: AsyncSmtpTransport<Tokio1Executor>,
    from: Mailbox,
    to: Vec<Mailbox>,
}

impl Mailer {
    /// # Errors
    /// An address is none, or the password cannot be read.
    pub fn new(mail: &config::Mail, authorities: &Authorities) -> Result<Self, Violation> {
        let mailbox = |key: &str, text: &str| {
            text.parse::<Mailbox>().map_err(|error| Violation {
                key: key.to_owned(),
                message: format!("is {text:?}, which is no address: {error}"),
            })
        };
        let parameters = || {
            authorities.mail(&mail.host).map_err(|error| Violation {
                key: "alerts.mail.host".to_owned(),
                message: format!("is {:?}: {error}", mail.host),
            })
        };
        let tls = match mail.tls {
            MailTls::Tls => Tls::Wrapper(parameters()?),
            MailTls::Starttls => Tls::Required(parameters()?),
            MailTls::None => Tls::None,
        };
        let mut transport = AsyncSmtpTransport::<Tokio1Executor>::builder_dangerous(mail.host.as_str())
            .port(mail.port)
            .tls(tls)
            .timeout(Some(PATIENCE));
        if let (Some(user), Some(path)) = (&mail.user, &mail.password_file) {
            let password = secret("alerts.mail.password_file", path)?;
            transport = transport.credentials(Credentials::new(user.clone(), password));
        }
        let to = mail.to.iter().map(|text| mailbox("alerts.mail.to", text)).collect::<Result<_, _>>()?;
        Ok(Self { transport: transport.build(), from: mailbox("alerts.mail.from", &mail.from)?, to })
    }

    pub async fn send(&self, letter: &Letter<'_>) -> Result<String, String> {
        let (subject, text) = words(letter);
        let mut message = Message::builder().from(self.from.clone()).subject(subject);
        for to in &self.to {
            message = message.to(to.clone());
        }
        let message =
            message.header(ContentType::TEXT_PLAIN).body(text).map_err(|error| error.to_string())?;
        let response = self.transport.send(message).await.map_err(|error| error.to_string())?;
        let said: Vec<&str> = response.message().collect();
        Ok(format!("{} {}", response.code(), said.join(" ")).trim().to_owned())
    }
}

/// Subject and text.
fn words(letter: &Letter<'_>) -> (String, String) {
    let Letter { site, is_test, alert } = letter;
    let state = match (is_test, alert.state) {
        (true, _) => "test",
        (false, AlertState::Active) => "alert",
        (false, AlertState::Acknowledged) => "acknowledged",
        (false, AlertState::ClearedUnacknowledged | AlertState::Cleared) => "over",
    };
    let subject = format!("[{site}] {state}: {}", alert.message);
    let mut text = format!("{}\n\nsince {}\n", alert.message, UtcTime(alert.raised));
    if let Some(cleared) = alert.cleared {
        text.push_str(&format!("until {}\n", UtcTime(cleared)));
    }
    if let Some(seen) = &alert.acknowledged {
        text.push_str(&format!("acknowledged by {} at {}", seen.by, UtcTime(seen.at)));
        text.push_str(&if seen.note.is_empty() { "\n".to_owned() } else { format!(": {}\n", seen.note) });
    }
    text.push_str(&format!("alert {}\n", alert.id));
    (subject, text)
}
