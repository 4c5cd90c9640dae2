//! Addresses of the wire: `tcp/HOST:PORT` or `tls/HOST:PORT`.

use super::{Violation, violation};

/// `Err` with what is wrong, unless every text is an endpoint that can be dialled or listened on. Checked here,
/// because a peer dials for ever what it takes for an address.
pub(crate) fn endpoints(key: &str, texts: &[String]) -> Result<(), Violation> {
    texts.iter().try_for_each(|text| match endpoint(text) {
        Ok(()) => Ok(()),
        Err(message) => violation(key, message),
    })
}

/// `Err` with what is wrong, unless every text is an endpoint to listen on that only this computer reaches, or
/// `unauthenticated` says that whoever else reaches it may be believed. `table` is the table of both keys, `instead` is
/// what else can be done.
pub(crate) fn listening(
    table: &str,
    texts: &[String],
    unauthenticated: bool,
    instead: &str,
) -> Result<(), Violation> {
    let key = format!("{table}.listen");
    endpoints(&key, texts)?;
    match texts.iter().find(|text| !unauthenticated && !is_loopback(text)) {
        None => Ok(()),
        Some(text) => violation(
            &key,
            format!(
                "is {text}, which others can reach, and who dials in is not asked who it is; listen on a loopback \
                 address, {instead}or set {table}.unauthenticated = true on a network that is yours alone"
            ),
        ),
    }
}

/// `Err` with what is wrong, unless every text is an endpoint of TLS.
pub(crate) fn secret(key: &str, texts: &[String]) -> Result<(), Violation> {
    match texts.iter().find(|text| !text.starts_with("tls/")) {
        None => Ok(()),
        Some(text) => violation(key, format!("is {text}, must begin with tls/ where there are certificates")),
    }
}

fn is_loopback(text: &str) -> bool {
    let address = text.split(['?', '#']).next().unwrap_or_default();
    let host = address.split_once('/').and_then(|(_, at)| at.rsplit_once(':')).map_or("", |(host, _)| host);
    let host = host.trim_start_matches('[').trim_end_matches(']');
    host == "localhost" || host.parse::<std::net::IpAddr>().is_ok_and(|address| address.is_loopback())
}

/// `Err` with what is wrong, unless `text` is an endpoint; options may follow after '?' or '#'.
///
/// # Errors
/// What is wrong, to be put after the name of a key or an argument.
pub fn endpoint(text: &str) -> Result<(), String> {
    let address = text.split(['?', '#']).next().unwrap_or_default();
    let host_and_port = address
        .strip_prefix("tcp/")
        .or_else(|| address.strip_prefix("tls/"))
        .and_then(|at| at.rsplit_once(':'));
    match host_and_port {
        Some((host, port)) if !host.is_empty() && port.parse::<u16>().is_ok() => Ok(()),
        _ => Err(format!("is \"{text}\", must be an endpoint such as tcp/192.168.1.10:7447")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_have_protocol_host_and_port() {
        for text in
            ["tcp/127.0.0.1:7447", "tcp/[::1]:0", "tls/site.example:7447", "tcp/10.0.0.1:7447#iface=eth0"]
        {
            assert_eq!(endpoint(text), Ok(()), "{text}");
        }
        for text in ["", "127.0.0.1:7447", "tcp/host", "tcp/:7447", "tcp/host:70000", "http/host:80"] {
            assert!(endpoint(text).expect_err("no endpoint").contains("tcp/192.168.1.10:7447"), "{text}");
        }
    }

    #[test]
    fn what_others_can_reach_is_refused_unless_asked_for() {
        let listen =
            |text: &str, unauthenticated| listening("zenoh", &[text.to_owned()], unauthenticated, "");
        for text in ["tcp/127.0.0.1:7447", "tcp/[::1]:0", "tls/localhost:7447"] {
            assert_eq!(listen(text, false), Ok(()), "{text}");
        }
        for text in ["tcp/0.0.0.0:7447", "tcp/192.168.1.10:7447", "tls/site.example:7447", "tcp/[::]:7447"] {
            let refusal = listen(text, false).expect_err("others can reach it").to_string();
            assert!(refusal.contains("zenoh.unauthenticated = true"), "{refusal}");
            assert_eq!(listen(text, true), Ok(()), "{text}");
        }
    }
}
