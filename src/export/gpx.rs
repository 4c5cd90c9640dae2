//! GPX 1.1: one `trk` a machine, one `trkseg` from gap to gap. It has no place for the state of the fixes.

use std::io::{self, Write};

use super::track::{Layout, Segment, utc, xml};

const HEAD: &str = concat!(
    "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n",
    "<gpx version=\"1.1\" creator=\"holdfast ",
    env!("CARGO_PKG_VERSION"),
    "\" xmlns=\"http://www.topografix.com/GPX/1/1\" xmlns:xsi=\"http://www.w3.org/2001/XMLSchema-instance\" ",
    "xsi:schemaLocation=\"http://www.topografix.com/GPX/1/1 http://www.topografix.com/GPX/1/1/gpx.xsd\">\n",
    "<metadata><desc>Heights are above the WGS84 ellipsoid.</desc></metadata>\n",
);

/// Whether a `trkseg` is open.
#[derive(Default)]
pub(super) struct Gpx {
    open: bool,
}

impl Gpx {
    fn close(&mut self, out: &mut dyn Write) -> io::Result<()> {
        if self.open {
            self.open = false;
            writeln!(out, "</trkseg>")?;
        }
        Ok(())
    }
}

impl Layout for Gpx {
    fn begin(&mut self, out: &mut dyn Write) -> io::Result<()> {
        write!(out, "{HEAD}")
    }

    fn begin_track(&mut self, out: &mut dyn Write, track: &str) -> io::Result<()> {
        writeln!(out, "<trk><name>{}</name>", xml(track))
    }

    fn segment(&mut self, out: &mut dyn Write, segment: &Segment<'_>) -> io::Result<()> {
        if segment.before.is_none() {
            self.close(out)?;
            self.open = true;
            writeln!(out, "<trkseg>")?;
        }
        for point in segment.points {
            let Some(place) = point.place else { continue };
            write!(out, "<trkpt lat=\"{:.9}\" lon=\"{:.9}\">", place.latitude_deg, place.longitude_deg)?;
            let time = utc(point.pose.stamp);
            writeln!(out, "<ele>{:.4}</ele><time>{time}</time></trkpt>", place.altitude_m)?;
        }
        Ok(())
    }

    fn end_track(&mut self, out: &mut dyn Write) -> io::Result<()> {
        self.close(out)?;
        writeln!(out, "</trk>")
    }

    fn end(&mut self, out: &mut dyn Write) -> io::Result<()> {
        writeln!(out, "</gpx>")
    }
}
