//! Where a request comes from, and to whom it is addressed: host names, origins, addresses. Values in, judgement
//! out.
//!
//! A page from elsewhere can reach the server through the visitor's browser: by a name that resolves to our address
//! (DNS rebinding), which the check of `Host` stops, or by a WebSocket or a form, which browsers let pass between
//! sites, and the checks of `Origin` and `Sec-Fetch-Site` stop.

use std::net::IpAddr;

use axum::http::header::{HOST, ORIGIN};
use axum::http::{HeaderMap, Uri};

use crate::config;

/// The page that a request comes from, as the browser tells it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Origin {
    /// No browser says anything.
    Untold,
    /// One of ours.
    Own,
    /// One of those whom the site file names.
    Listed,
    /// Somebody else's.
    Foreign,
}

/// The host that a request is addressed to, if it is one of ours.
///
/// # Errors
/// There is none (`None`), or it is none of ours.
pub(super) fn host<'a>(
    http: &config::Http,
    headers: &'a HeaderMap,
    uri: &'a Uri,
) -> Result<&'a str, Option<&'a str>> {
    let told = || headers.get(HOST).map(|value| value.to_str().unwrap_or(""));
    let host = uri.authority().map(axum::http::uri::Authority::as_str).or_else(told).ok_or(None)?;
    if is_ours(http, host) { Ok(host) } else { Err(Some(host)) }
}

/// Whether a `host` or `host:port` is this server, whatever DNS says: an address, or a name of the site file.
fn is_ours(http: &config::Http, host: &str) -> bool {
    let name = match host.rsplit_once(':') {
        Some((name, port)) if port.bytes().all(|byte| byte.is_ascii_digit()) => name,
        _ => host,
    };
    if name.eq_ignore_ascii_case("localhost") || http.names.iter().any(|ours| ours.eq_ignore_ascii_case(name))
    {
        return true;
    }
    let address = name.trim_start_matches('[').trim_end_matches(']').parse::<IpAddr>();
    address.is_ok_and(|address| address.is_loopback() || !http.listen.ip().is_loopback())
}

/// The page that a request to `host` comes from.
pub(super) fn origin(http: &config::Http, headers: &HeaderMap, host: &str) -> Origin {
    let text = |name: &str| headers.get(name).map(|value| value.to_str().unwrap_or(""));
    let Some(origin) = text(ORIGIN.as_str()) else {
        return match text("sec-fetch-site") {
            None => Origin::Untold,
            Some("same-origin" | "none") => Origin::Own,
            Some(_) => Origin::Foreign,
        };
    };
    let is_own = origin.split_once("://").is_some_and(|(scheme, authority)| {
        authority.eq_ignore_ascii_case(host) && (scheme == "https" || (scheme == "http" && !http.https))
    });
    if is_own {
        Origin::Own
    } else if http.origins.iter().any(|listed| listed == origin) {
        Origin::Listed
    } else {
        Origin::Foreign
    }
}

/// The client behind a connection: if that is a proxy of ours, whom the proxy says it speaks for.
pub(super) fn client(http: &config::Http, headers: &HeaderMap, peer: IpAddr) -> IpAddr {
    let peer = peer.to_canonical();
    if !http.proxies.iter().any(|proxy| proxy.to_canonical() == peer) {
        return peer;
    }
    // Whoever is before our proxies may have written what he likes further left.
    let told = headers.get_all("x-forwarded-for").iter().filter_map(|value| value.to_str().ok());
    let told: Vec<&str> = told.flat_map(|value| value.split(',')).map(str::trim).collect();
    let addresses =
        told.iter().rev().map_while(|text| text.parse::<IpAddr>().ok()).map(|ip| ip.to_canonical());
    let mut nearest = peer;
    for address in addresses {
        nearest = address;
        if !http.proxies.iter().any(|proxy| proxy.to_canonical() == address) {
            break;
        }
    }
    nearest
}

/// Whose permits a client takes: its address, in IPv6 its network, of which it has many.
pub(super) fn bucket(client: IpAddr) -> String {
    match client {
        IpAddr::V4(address) => address.to_string(),
        IpAddr::V6(address) => {
            let [a, b, c, d, ..] = address.segments();
            format!("{a:x}:{b:x}:{c:x}:{d:x}::/64")
        }
    }
}

#[cfg(test)]
mod tests {
    use axum::http::{HeaderName, HeaderValue};

    use super::*;

    fn headers(pairs: &[(&'static str, &'static str)]) -> HeaderMap {
        let pairs = pairs.iter();
        HeaderMap::from_iter(
            pairs.map(|(name, value)| (HeaderName::from_static(name), HeaderValue::from_static(value))),
        )
    }

    #[test]
    fn only_names_that_no_dns_can_turn_are_ours() {
        let mut http = config::Http::default();
        for host in
            ["localhost", "LOCALHOST:8080", "127.0.0.1", "127.0.0.1:80", "127.9.9.9", "[::1]:8080", "[::1]"]
        {
            assert!(is_ours(&http, host), "{host}");
        }
        let others = ["", "evil.example", "localhost.evil.example:80", "127.0.0.1.evil.example"];
        for host in others.into_iter().chain(["192.168.0.1:8080", "0.0.0.0", "site.example"]) {
            assert!(!is_ours(&http, host), "{host}");
        }
        http.listen = "0.0.0.0:8080".parse().expect("address");
        http.names = vec!["site.example".to_owned()];
        for host in ["192.168.0.1:8080", "[2001:db8::1]:8080", "Site.Example:8080", "localhost"] {
            assert!(is_ours(&http, host), "{host}");
        }
        for host in others {
            assert!(!is_ours(&http, host), "{host}");
        }
    }

    #[test]
    fn pages_of_other_origins_are_told_from_ours() {
        let mut http =
            config::Http { origins: vec!["https://portal.example".to_owned()], ..Default::default() };
        let host = "127.0.0.1:8080";
        let of =
            |http: &config::Http, pairs: &[(&'static str, &'static str)]| origin(http, &headers(pairs), host);
        assert_eq!(of(&http, &[]), Origin::Untold);
        assert_eq!(of(&http, &[("origin", "http://127.0.0.1:8080")]), Origin::Own);
        assert_eq!(of(&http, &[("sec-fetch-site", "same-origin")]), Origin::Own);
        assert_eq!(of(&http, &[("origin", "https://portal.example")]), Origin::Listed);
        for foreign in [
            "http://evil.example",
            "null",
            "http://127.0.0.1:9090",
            "http://localhost:8080",
            "",
            "ftp://127.0.0.1:8080",
        ] {
            assert_eq!(of(&http, &[("origin", foreign)]), Origin::Foreign, "{foreign}");
        }
        for foreign in ["cross-site", "same-site"] {
            assert_eq!(of(&http, &[("sec-fetch-site", foreign)]), Origin::Foreign, "{foreign}");
        }
        http.https = true;
        assert_eq!(of(&http, &[("origin", "http://127.0.0.1:8080")]), Origin::Foreign);
        assert_eq!(of(&http, &[("origin", "https://127.0.0.1:8080")]), Origin::Own);
    }

    #[test]
    fn only_our_proxies_are_believed_whom_they_speak_for() {
        let address = |text: &str| text.parse::<IpAddr>().expect("an address");
        let mut http = config::Http::default();
        let told = headers(&[("x-forwarded-for", "1.1.1.1, 2.2.2.2, 10.0.0.9")]);
        assert_eq!(client(&http, &told, address("10.0.0.1")), address("10.0.0.1"));
        http.proxies = vec![address("10.0.0.1")];
        assert_eq!(client(&http, &told, address("::ffff:10.0.0.1")), address("10.0.0.9"));
        http.proxies.push(address("10.0.0.9"));
        assert_eq!(client(&http, &told, address("10.0.0.1")), address("2.2.2.2"));
        let nonsense = headers(&[("x-forwarded-for", "1.1.1.1, unknown")]);
        assert_eq!(client(&http, &nonsense, address("10.0.0.1")), address("10.0.0.1"));
        assert_eq!(bucket(address("2001:db8:1:2:3:4:5:6")), "2001:db8:1:2::/64");
    }
}
