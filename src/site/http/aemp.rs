//! The fleet as telematics systems exchange it: ISO/TS 15143-3 (AEMP 2.0), the fleet snapshot, in XML and JSON.
//!
//! The standard's text is not public. Namespace, names, their order and the paging are taken from what is: its table of
//! contents (snapshot 8.2.1, links 8.4, header 11.2, location 11.3), the public documentation of implementations by
//! Trackunit and Proemion (pages from 1, up to 100 machines, `Links` with `rel` and `href`, XML unless asked for JSON,
//! times to the second in UTC), the open client of MiX Telematics (namespace, `version` and `snapshotTime`, fields of
//! header and location), and published answers of Bell, Develon and Takeuchi (`datetime` as an attribute, `metre`). JSON
//! has the same names; attributes stand beside elements.
//!
//! Of the header, `EquipmentID` is the machine's id; make, model, serial number and PIN are what the site file's
//! `[[equipment]]` says, and left out rather than made up where it says nothing, as are hours and fuel. What the standard
//! has no place for, how good a position is, is in a namespace of our own, [`QUALITY`].

use axum::extract::rejection::PathRejection;
use axum::extract::{Path, State};
use axum::http::header::{ACCEPT, CONTENT_TYPE, VARY};
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use quick_xml::Writer;
use quick_xml::events::{BytesDecl, BytesText, Event};
use serde::Serialize;

use super::Shared;
use super::accept::{Form, preferred};
use super::input::malformed;
use super::problem::Problem;
use crate::config;
use crate::fleet::{FleetView, MachineView, Presence, Severity, UtcTime};
use crate::state::{GnssState, Mode};
use crate::time::Stamp;

/// Machines on a page.
const PAGE: usize = 100;
/// The standard's.
const STANDARD: &str = "http://standards.iso.org/iso/15143/-3";
/// Ours, for what the standard has no place for.
const QUALITY: &str = "urn:holdfast:pose-quality:1";
const VERSION: &str = "1";

/// A page of the fleet, by the names of ISO/TS 15143-3.
#[derive(Debug, Serialize, utoipa::ToSchema)]
#[schema(as = aemp::Fleet)]
pub(super) struct Fleet {
    version: &'static str,
    /// When the page was made, to the second.
    #[serde(rename = "snapshotTime")]
    #[schema(format = DateTime)]
    snapshot_time: String,
    #[serde(rename = "Links")]
    links: Vec<Link>,
    #[serde(rename = "Equipment")]
    equipment: Vec<Equipment>,
}

/// Where another page is.
#[derive(Debug, PartialEq, Serialize, utoipa::ToSchema)]
#[schema(as = aemp::Link)]
pub(super) struct Link {
    /// `self`, `first`, `prev`, `next` or `last`.
    rel: &'static str,
    /// On this server.
    href: String,
}

/// A machine.
#[derive(Debug, Serialize, utoipa::ToSchema)]
#[schema(as = aemp::Equipment)]
#[serde(rename_all = "PascalCase")]
pub(super) struct Equipment {
    equipment_header: EquipmentHeader,
    /// Left out as long as the machine has not told where it is.
    #[serde(skip_serializing_if = "Option::is_none")]
    location: Option<Location>,
    /// In the namespace `urn:holdfast:pose-quality:1`.
    #[serde(rename = "hf:PoseQuality")]
    quality: PoseQuality,
}

/// Who it is.
#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
#[schema(as = aemp::EquipmentHeader)]
pub(super) struct EquipmentHeader {
    /// Its maker, if the site file says so.
    #[serde(rename = "OEMName", skip_serializing_if = "Option::is_none")]
    oem_name: Option<String>,
    /// Likewise.
    #[serde(rename = "Model", skip_serializing_if = "Option::is_none")]
    model: Option<String>,
    /// The machine's id.
    #[serde(rename = "EquipmentID")]
    equipment_id: String,
    /// Its maker's number, if the site file says so.
    #[serde(rename = "SerialNumber", skip_serializing_if = "Option::is_none")]
    serial_number: Option<String>,
    /// Product identification number, if the site file says so.
    #[serde(rename = "PIN", skip_serializing_if = "Option::is_none")]
    pin: Option<String>,
}

impl EquipmentHeader {
    fn of(machine: &str, known: &[config::Equipment]) -> Self {
        let known = known.iter().find(|known| known.machine == machine).cloned().unwrap_or_default();
        Self {
            oem_name: known.oem_name,
            model: known.model,
            equipment_id: machine.to_owned(),
            serial_number: known.serial_number,
            pin: known.pin,
        }
    }

    /// By the standard's names, in its order.
    fn elements(&self) -> impl Iterator<Item = (&'static str, String)> {
        let Self { oem_name, model, equipment_id, serial_number, pin } = self.clone();
        [
            ("OEMName", oem_name),
            ("Model", model),
            ("EquipmentID", Some(equipment_id)),
            ("SerialNumber", serial_number),
            ("PIN", pin),
        ]
        .into_iter()
        .filter_map(|(name, text)| Some((name, text?)))
    }
}

/// Its last known location: of the cabin IMU, WGS84.
#[derive(Debug, Serialize, utoipa::ToSchema)]
#[schema(as = aemp::Location)]
#[serde(rename_all = "PascalCase")]
pub(super) struct Location {
    /// To the second.
    #[serde(rename = "datetime")]
    #[schema(format = DateTime)]
    datetime: String,
    /// Degrees.
    latitude: f64,
    /// Degrees.
    longitude: f64,
    /// Above the ellipsoid.
    altitude: f64,
    /// `metre`.
    altitude_units: &'static str,
}

/// How far the location can be trusted.
#[derive(Debug, Serialize, utoipa::ToSchema)]
#[schema(as = aemp::PoseQuality)]
#[serde(rename_all = "PascalCase")]
pub(super) struct PoseQuality {
    /// What people call the machine.
    name: String,
    /// Whether it is there.
    presence: Presence,
    /// Its state in a few words.
    state: String,
    /// How much that asks for attention.
    severity: Severity,
    /// What its estimate rests on.
    #[serde(skip_serializing_if = "Option::is_none")]
    mode: Option<Mode>,
    /// State of its fixes.
    #[serde(skip_serializing_if = "Option::is_none")]
    gnss: Option<GnssState>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pose: Option<Pose>,
}

/// The pose behind the location.
#[derive(Debug, Serialize, utoipa::ToSchema)]
#[schema(as = aemp::Pose)]
#[serde(rename_all = "PascalCase")]
pub(super) struct Pose {
    /// By the machine's stamps, to the nanosecond.
    #[serde(rename = "datetime")]
    #[schema(format = DateTime)]
    datetime: String,
    /// Since it arrived, s.
    age_seconds: f64,
    /// One sigma, m.
    position_sigma_east_metres: f64,
    /// One sigma, m.
    position_sigma_north_metres: f64,
    /// One sigma, m.
    position_sigma_up_metres: f64,
    /// Half axis of the horizontal ellipse of 95 % probability, m.
    ellipse95_semi_major_metres: f64,
    /// Half axis of it, m.
    ellipse95_semi_minor_metres: f64,
    /// Of its longer axis, from the site's north, clockwise.
    ellipse95_bearing_degrees: f64,
    /// Of the cabin, from the site's north, clockwise.
    heading_degrees: f64,
    /// One sigma.
    heading_sigma_degrees: f64,
}

/// The fleet by ISO/TS 15143-3 (AEMP 2.0), 100 machines a page, as XML unless `Accept` prefers JSON. How good each
/// position is stands in the namespace `urn:holdfast:pose-quality:1`, in JSON under `hf:PoseQuality`.
#[utoipa::path(get, path = "/aemp/2.0/Fleet/{page}", operation_id = "aemp_fleet", tag = "fleet",
    params(("page" = u32, Path, description = "From 1", minimum = 1),
        ("Accept" = Option<String>, Header, description = "application/xml, text/xml or application/json")),
    responses((status = OK, content((Fleet = "application/json"), (String = "application/xml"), (String = "text/xml")),
            headers(("Vary" = String, description = "Accept"))),
        (status = BAD_REQUEST, body = Problem, content_type = "application/problem+json"),
        (status = NOT_FOUND, description = "There is no such page", body = Problem,
            content_type = "application/problem+json"),
        (status = NOT_ACCEPTABLE, description = "Neither XML nor JSON is wanted", body = Problem,
            content_type = "application/problem+json")))]
pub(super) async fn fleet(
    State(shared): State<Shared>,
    page: Result<Path<u32>, PathRejection>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let Path(page) = page.map_err(malformed)?;
    let accepted = headers.get_all(ACCEPT).iter().filter_map(|value| value.to_str().ok());
    let form = preferred(&accepted.collect::<Vec<_>>().join(","));
    let form = form.ok_or_else(|| {
        Problem::new(
            StatusCode::NOT_ACCEPTABLE,
            "this comes as application/xml, text/xml and application/json",
        )
    })?;
    let fleet = page_of(&shared.frame().view, &shared.equipment, page)?;
    let unwritten = |error: &dyn std::fmt::Display| {
        tracing::error!("the fleet cannot be written: {error}");
        Problem::new(StatusCode::INTERNAL_SERVER_ERROR, "the answer cannot be written")
    };
    let (kind, bytes) = match form {
        Form::Json => ("application/json", serde_json::to_vec(&fleet).map_err(|error| unwritten(&error))?),
        Form::Xml => ("application/xml; charset=utf-8", xml(&fleet).map_err(|error| unwritten(&error))?),
        Form::TextXml => ("text/xml; charset=utf-8", xml(&fleet).map_err(|error| unwritten(&error))?),
    };
    let mut response = ([(CONTENT_TYPE, kind)], bytes).into_response();
    response.headers_mut().append(VARY, HeaderValue::from_static("Accept"));
    Ok(response)
}

fn page_of(view: &FleetView, known: &[config::Equipment], page: u32) -> Result<Fleet, Problem> {
    // The first page is there also when there are no machines.
    let last = view.machines.len().div_ceil(PAGE).max(1) as u32;
    if !(1..=last).contains(&page) {
        let detail = format!("there is no page {page}: they count from 1 to {last}");
        return Err(Problem::new(StatusCode::NOT_FOUND, detail));
    }
    let machines = view.machines.iter().skip((page as usize - 1) * PAGE).take(PAGE);
    Ok(Fleet {
        version: VERSION,
        snapshot_time: seconds(view.time),
        links: links(page, last),
        equipment: machines.map(|machine| equipment(machine, known)).collect(),
    })
}

fn links(page: u32, last: u32) -> Vec<Link> {
    let link = |rel, page: u32| Link { rel, href: format!("/aemp/2.0/Fleet/{page}") };
    let mut links = vec![link("self", page), link("first", 1)];
    links.extend((page > 1).then(|| link("prev", page - 1)));
    links.extend((page < last).then(|| link("next", page + 1)));
    links.push(link("last", last));
    links
}

fn equipment(machine: &MachineView, known: &[config::Equipment]) -> Equipment {
    let report = machine.health.as_ref().map(|health| &health.report);
    let location = machine.pose.as_ref().map(|pose| Location {
        datetime: seconds(pose.stamp),
        latitude: pose.latitude_deg,
        longitude: pose.longitude_deg,
        altitude: pose.altitude_m,
        altitude_units: "metre",
    });
    let pose = machine.pose.as_ref().map(|pose| Pose {
        datetime: pose.stamp.to_string(),
        age_seconds: pose.age_s,
        position_sigma_east_metres: pose.position_sigma_m[0],
        position_sigma_north_metres: pose.position_sigma_m[1],
        position_sigma_up_metres: pose.position_sigma_m[2],
        ellipse95_semi_major_metres: pose.ellipse95.semi_major_m,
        ellipse95_semi_minor_metres: pose.ellipse95.semi_minor_m,
        ellipse95_bearing_degrees: pose.ellipse95.bearing_deg,
        heading_degrees: pose.heading_deg,
        heading_sigma_degrees: pose.heading_sigma_deg,
    });
    Equipment {
        equipment_header: EquipmentHeader::of(&machine.id, known),
        location,
        quality: PoseQuality {
            name: machine.name.clone(),
            presence: machine.presence,
            state: machine.state_word.clone(),
            severity: machine.severity,
            mode: report.map(|report| report.mode),
            gnss: report.map(|report| report.gnss),
            pose,
        },
    }
}

/// The second that has begun.
fn seconds(time: UtcTime) -> String {
    let nanos = time.0.as_nanos();
    let whole = UtcTime(Stamp::from_nanos(nanos.saturating_sub(nanos.rem_euclid(1_000_000_000))));
    whole.to_string().replace(".000000000Z", "Z")
}

fn xml(fleet: &Fleet) -> std::io::Result<Vec<u8>> {
    let mut writer = Writer::new(Vec::new());
    writer.write_event(Event::Decl(BytesDecl::new("1.0", Some("UTF-8"), None)))?;
    let root = writer.create_element("Fleet").with_attributes([
        ("xmlns", STANDARD),
        ("xmlns:hf", QUALITY),
        ("version", fleet.version),
        ("snapshotTime", fleet.snapshot_time.as_str()),
    ]);
    root.write_inner_content(|writer| {
        for Link { rel, href } in &fleet.links {
            writer.create_element("Links").write_inner_content(|writer| {
                texts(writer, [("rel", rel.to_string()), ("href", href.clone())])
            })?;
        }
        fleet.equipment.iter().try_for_each(|equipment| xml_equipment(writer, equipment))
    })?;
    Ok(writer.into_inner())
}

fn xml_equipment(writer: &mut Writer<Vec<u8>>, equipment: &Equipment) -> std::io::Result<()> {
    let Equipment { equipment_header, location, quality } = equipment;
    writer.create_element("Equipment").write_inner_content(|writer| {
        writer
            .create_element("EquipmentHeader")
            .write_inner_content(|writer| texts(writer, equipment_header.elements()))?;
        if let Some(location) = location {
            let element = writer.create_element("Location");
            element.with_attribute(("datetime", location.datetime.as_str())).write_inner_content(
                |writer| {
                    texts(
                        writer,
                        [
                            ("Latitude", location.latitude.to_string()),
                            ("Longitude", location.longitude.to_string()),
                            ("Altitude", location.altitude.to_string()),
                            ("AltitudeUnits", location.altitude_units.to_owned()),
                        ],
                    )
                },
            )?;
        }
        writer.create_element("hf:PoseQuality").write_inner_content(|writer| xml_quality(writer, quality))?;
        Ok(())
    })?;
    Ok(())
}

fn xml_quality(writer: &mut Writer<Vec<u8>>, quality: &PoseQuality) -> std::io::Result<()> {
    texts(
        writer,
        [
            ("hf:Name", quality.name.clone()),
            ("hf:Presence", quality.presence.name().to_owned()),
            ("hf:State", quality.state.clone()),
            ("hf:Severity", quality.severity.name().to_owned()),
        ],
    )?;
    let mode = quality.mode.map(|mode| ("hf:Mode", mode.name().to_owned()));
    texts(writer, mode.into_iter().chain(quality.gnss.map(|gnss| ("hf:Gnss", gnss.name().to_owned()))))?;
    let Some(pose) = &quality.pose else { return Ok(()) };
    let element = writer.create_element("hf:Pose").with_attribute(("datetime", pose.datetime.as_str()));
    element.write_inner_content(|writer| {
        let numbers = [
            ("hf:AgeSeconds", pose.age_seconds),
            ("hf:PositionSigmaEastMetres", pose.position_sigma_east_metres),
            ("hf:PositionSigmaNorthMetres", pose.position_sigma_north_metres),
            ("hf:PositionSigmaUpMetres", pose.position_sigma_up_metres),
            ("hf:Ellipse95SemiMajorMetres", pose.ellipse95_semi_major_metres),
            ("hf:Ellipse95SemiMinorMetres", pose.ellipse95_semi_minor_metres),
            ("hf:Ellipse95BearingDegrees", pose.ellipse95_bearing_degrees),
            ("hf:HeadingDegrees", pose.heading_degrees),
            ("hf:HeadingSigmaDegrees", pose.heading_sigma_degrees),
        ];
        texts(writer, numbers.map(|(name, number)| (name, number.to_string())))
    })?;
    Ok(())
}

/// Elements with nothing but text in them, which is escaped.
fn texts(
    writer: &mut Writer<Vec<u8>>,
    elements: impl IntoIterator<Item = (&'static str, String)>,
) -> std::io::Result<()> {
    for (name, text) in elements {
        writer.create_element(name).write_text_content(BytesText::new(&legal(&text)))?;
    }
    Ok(())
}

/// Without the characters that XML 1.0 has no way to write: names come from outside.
fn legal(text: &str) -> String {
    let is_legal =
        |c: char| !c.is_control() && c != '\u{fffe}' && c != '\u{ffff}' || matches!(c, '\t' | '\n' | '\r');
    text.chars().map(|c| if is_legal(c) { c } else { '\u{fffd}' }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn header_has_what_the_site_file_says_in_the_standards_order_and_nothing_else() {
        let known = [config::Equipment {
            machine: "a".to_owned(),
            oem_name: Some("Menzi & Muck".to_owned()),
            pin: Some("*1*".to_owned()),
            ..Default::default()
        }];
        let of = |machine| EquipmentHeader::of(machine, &known).elements().collect::<Vec<_>>();
        let text = |name, text: &str| (name, text.to_owned());
        let expected = [text("OEMName", "Menzi & Muck"), text("EquipmentID", "a"), text("PIN", "*1*")];
        assert_eq!(of("a"), expected);
        assert_eq!(of("b"), [text("EquipmentID", "b")]);
        let json = serde_json::to_value(EquipmentHeader::of("a", &known)).expect("JSON");
        let expected = serde_json::json!({"OEMName": "Menzi & Muck", "EquipmentID": "a", "PIN": "*1*"});
        assert_eq!(json, expected);
    }

    #[test]
    fn pages_lead_to_each_other() {
        let of = |page, last| {
            let links = links(page, last).into_iter();
            links.map(|link| format!("{} {}", link.rel, link.href.replace("/aemp/2.0/Fleet/", "")))
        };
        assert!(of(1, 1).eq(["self 1", "first 1", "last 1"]));
        assert!(of(2, 3).eq(["self 2", "first 1", "prev 1", "next 3", "last 3"]));
        assert!(of(3, 3).eq(["self 3", "first 1", "prev 2", "last 3"]));
    }

    #[test]
    fn times_are_to_the_second_and_text_is_what_xml_can_hold() {
        let at = |nanos| seconds(UtcTime(Stamp::from_nanos(nanos)));
        assert_eq!(at(1_795_410_000_999_999_999), "2026-11-23T05:00:00Z");
        assert_eq!(at(-1), "1969-12-31T23:59:59Z");
        let mut writer = Writer::new(Vec::new());
        texts(&mut writer, [("a", "<b>&\"\u{0}\u{1b}é".to_owned())]).expect("written");
        let text = String::from_utf8(writer.into_inner()).expect("UTF-8");
        assert!(text.starts_with("<a>&lt;b&gt;&amp;"), "{text}");
        assert!(text.ends_with("\u{fffd}\u{fffd}é</a>"), "{text}");
    }
}
