//! GeoJSON (RFC 7946): one Feature a segment.

use std::io::{self, Write};

use super::track::{Layout, Segment, utc};

/// A FeatureCollection of LineStrings; a segment of one pose is a Point.
#[derive(Default)]
pub(super) struct GeoJson {
    features: u64,
}

impl Layout for GeoJson {
    fn begin(&mut self, out: &mut dyn Write) -> io::Result<()> {
        write!(out, "{{\"type\":\"FeatureCollection\",\"features\":[")
    }

    fn segment(&mut self, out: &mut dyn Write, segment: &Segment<'_>) -> io::Result<()> {
        let comma = if self.features > 0 { "," } else { "" };
        self.features += 1;
        let count = segment.line().count();
        let (kind, open, close) = if count > 1 { ("LineString", "[", "]") } else { ("Point", "", "") };
        let geometry = format_args!("{{\"type\":\"{kind}\",\"coordinates\":{open}");
        write!(out, "{comma}\n{{\"type\":\"Feature\",\"geometry\":{geometry}")?;
        for (index, (_, place)) in segment.line().enumerate() {
            let comma = if index > 0 { "," } else { "" };
            write!(out, "{comma}[{:.9},{:.9},", place.longitude_deg, place.latitude_deg)?;
            write!(out, "{:.4}]", place.altitude_m)?;
        }
        let (start, end) = segment.span();
        write!(out, "{close}}},\"properties\":{{\"machine\":{}", serde_json::to_string(segment.track)?)?;
        write!(out, ",\"segment\":{},\"poses\":{}", segment.index, segment.points.len())?;
        write!(out, ",\"start\":\"{}\",\"end\":\"{}\"", utc(start), utc(end))?;
        write!(out, ",\"gnss\":\"{}\"", segment.gnss.name())?;
        if let Some(cause) = segment.gnss.cause() {
            write!(out, ",\"cause\":{}", serde_json::to_string(cause)?)?;
        }
        write!(out, ",\"coordTimes\":[")?;
        for (index, (stamp, _)) in segment.line().enumerate() {
            let comma = if index > 0 { "," } else { "" };
            write!(out, "{comma}\"{}\"", utc(stamp))?;
        }
        write!(out, "]}}}}")
    }

    fn end(&mut self, out: &mut dyn Write) -> io::Result<()> {
        writeln!(out, "\n]}}")
    }
}
