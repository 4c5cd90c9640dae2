//! KML 2.2: a Folder for each machine, a Placemark with a `gx:Track` for each segment, red in an outage.
//!
//! KML's absolute heights are above the geoid and ours above the ellipsoid, some 50 m apart in Europe: tracks are
//! drawn on the ground, and carry the height in their coordinates.

use std::io::{self, Write};

use super::track::{Gnss, Layout, Segment, utc, xml};

const HEAD: &str = concat!(
    "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n",
    "<kml xmlns=\"http://www.opengis.net/kml/2.2\" xmlns:gx=\"http://www.google.com/kml/ext/2.2\">\n",
    "<Document>\n<name>holdfast</name>\n",
    "<description>Heights are above the WGS84 ellipsoid.</description>\n",
    "<Style id=\"good\"><LineStyle><color>ff50b000</color><width>3</width></LineStyle></Style>\n",
    "<Style id=\"outage\"><LineStyle><color>ff2020e0</color><width>3</width></LineStyle></Style>\n",
    "<Style id=\"unknown\"><LineStyle><color>ffe08020</color><width>3</width></LineStyle></Style>\n",
);

pub(super) struct Kml;

impl Layout for Kml {
    fn begin(&mut self, out: &mut dyn Write) -> io::Result<()> {
        write!(out, "{HEAD}")
    }

    fn begin_track(&mut self, out: &mut dyn Write, track: &str) -> io::Result<()> {
        writeln!(out, "<Folder><name>{}</name>", xml(track))
    }

    fn segment(&mut self, out: &mut dyn Write, segment: &Segment<'_>) -> io::Result<()> {
        let (start, end) = segment.span();
        write!(out, "<Placemark><name>{} {}</name>", xml(segment.track), segment.index)?;
        if let Gnss::Out(cause) = segment.gnss {
            write!(out, "<description>GNSS outage: {}</description>", xml(cause))?;
        }
        write!(out, "<TimeSpan><begin>{}</begin><end>{}</end></TimeSpan>", utc(start), utc(end))?;
        writeln!(out, "<styleUrl>#{}</styleUrl>", segment.gnss.name())?;
        writeln!(out, "<gx:Track><altitudeMode>clampToGround</altitudeMode>")?;
        for (stamp, _) in segment.line() {
            writeln!(out, "<when>{}</when>", utc(stamp))?;
        }
        for (_, place) in segment.line() {
            write!(out, "<gx:coord>{:.9} {:.9} ", place.longitude_deg, place.latitude_deg)?;
            writeln!(out, "{:.4}</gx:coord>", place.altitude_m)?;
        }
        writeln!(out, "</gx:Track></Placemark>")
    }

    fn end_track(&mut self, out: &mut dyn Write) -> io::Result<()> {
        writeln!(out, "</Folder>")
    }

    fn end(&mut self, out: &mut dyn Write) -> io::Result<()> {
        writeln!(out, "</Document>\n</kml>")
    }
}
