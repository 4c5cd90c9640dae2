//! Formats of a line a pose: TUM and CSV.

use std::io::{self, Write};

use super::track::{Layout, Segment};
use crate::lie::Vec3;
use crate::time::Stamp;

/// `t x y z qx qy qz qw`: one trajectory, without its name.
pub(super) struct Tum;

/// All tracks under one header; the place in WGS84 only where the origin is known.
pub(super) struct Csv {
    pub(super) with_place: bool,
}

pub(super) fn write_tum(
    out: &mut (impl Write + ?Sized),
    stamp: Stamp,
    position: &Vec3,
    [x, y, z, w]: [f64; 4],
) -> io::Result<()> {
    writeln!(out, "{stamp} {} {} {} {x} {y} {z} {w}", position.x, position.y, position.z)
}

impl Layout for Tum {
    fn segment(&mut self, out: &mut dyn Write, segment: &Segment<'_>) -> io::Result<()> {
        segment.points.iter().try_for_each(|point| {
            write_tum(out, point.pose.stamp, &point.pose.position, point.pose.quaternion_xyzw)
        })
    }
}

impl Layout for Csv {
    fn begin(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let place = if self.with_place { ",latitude_deg,longitude_deg,altitude_m" } else { "" };
        writeln!(out, "machine,t,x,y,z,qx,qy,qz,qw,gnss{place}")
    }

    fn segment(&mut self, out: &mut dyn Write, segment: &Segment<'_>) -> io::Result<()> {
        let track = quoted(segment.track);
        for point in segment.points {
            let position = &point.pose.position;
            let [x, y, z, w] = point.pose.quaternion_xyzw;
            write!(out, "{track},{},{},{},{},", point.pose.stamp, position.x, position.y, position.z)?;
            write!(out, "{x},{y},{z},{w},{}", segment.gnss.name())?;
            if let Some(place) = &point.place {
                write!(out, ",{:.10},{:.10},", place.latitude_deg, place.longitude_deg)?;
                write!(out, "{:.5}", place.altitude_m)?;
            }
            writeln!(out)?;
        }
        Ok(())
    }
}

/// A field of CSV (RFC 4180); machine ids need no quotes, file names may.
fn quoted(text: &str) -> String {
    if text.contains(['"', ',', '\n', '\r']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text.to_owned()
    }
}
