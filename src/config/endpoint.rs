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
}
