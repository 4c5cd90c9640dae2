//! Which form of an answer a client likes most (RFC 9110, 12.5.1).

/// What the fleet by ISO/TS 15143-3 comes as.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Form {
    Xml,
    TextXml,
    Json,
}

/// What a client likes most of what there is; of equals the first. `None` if it likes nothing of it.
pub(super) fn preferred(accept: &str) -> Option<Form> {
    if accept.trim().is_empty() {
        return Some(Form::Xml);
    }
    let mut best: Option<(f64, Form)> = None;
    for (form, kind) in
        [(Form::Xml, "application/xml"), (Form::TextXml, "text/xml"), (Form::Json, "application/json")]
    {
        let quality = quality(accept, kind);
        if quality > best.map_or(0.0, |(best, _)| best) {
            best = Some((quality, form));
        }
    }
    best.map(|(_, form)| form)
}

/// What the most specific range says of a media type (RFC 9110, 12.5.1); 0 is not acceptable.
fn quality(accept: &str, kind: &str) -> f64 {
    let family = kind.split('/').next().unwrap_or("");
    let mut found = (0, 0.0);
    for range in accept.split(',') {
        let mut parts = range.split(';').map(str::trim);
        let name = parts.next().unwrap_or("").to_ascii_lowercase();
        let quality = parts
            .filter_map(|part| part.split_once('='))
            .find(|(key, _)| key.trim().eq_ignore_ascii_case("q"))
            .map_or(1.0, |(_, value)| value.trim().parse::<f64>().unwrap_or(0.0).clamp(0.0, 1.0));
        let specific = match name.as_str() {
            "*/*" => 1,
            name if name.strip_suffix("/*").is_some_and(|of| of == family) => 2,
            name if name == kind => 3,
            _ => 0,
        };
        if specific > found.0 {
            found = (specific, quality);
        }
    }
    found.1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clients_get_what_they_like_most() {
        for (accept, form) in [
            ("", Some(Form::Xml)),
            ("*/*", Some(Form::Xml)),
            ("application/json", Some(Form::Json)),
            ("Application/JSON; charset=utf-8", Some(Form::Json)),
            ("text/xml", Some(Form::TextXml)),
            ("application/xml;q=0.5, application/json", Some(Form::Json)),
            ("application/json;q=0.5, */*;q=0.1", Some(Form::Json)),
            ("application/*", Some(Form::Xml)),
            ("text/*;q=0.9, application/xml;q=0.1", Some(Form::TextXml)),
            // The more specific range counts, wherever it stands.
            ("application/xml;q=0, */*", Some(Form::TextXml)),
            ("*/*, application/xml;q=0, text/xml;q=0", Some(Form::Json)),
            ("text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8", Some(Form::Xml)),
            ("image/png", None),
            ("application/json;q=0", None),
            ("application/json;q=x", None),
        ] {
            assert_eq!(preferred(accept), form, "{accept}");
        }
    }
}
