//! What runs on a machine and how it is configured: asked of the machine itself, on request.

use std::time::Duration;

use axum::Json;
use axum::extract::rejection::PathRejection;
use axum::extract::{Path, State};
use axum::http::StatusCode;
use serde::Serialize;

use super::Shared;
use super::input::malformed;
use super::problem::Problem;
use crate::wire::{BootId, JournalHead, configuration_key};

/// A machine on a bad link may take so long.
const PATIENCE: Duration = Duration::from_secs(3);
/// Nobody's machine file is longer.
const ANSWER_BYTES_MAX: usize = 1_000_000;

/// What runs on a machine, and how it is configured.
#[derive(Serialize, utoipa::ToSchema)]
pub(super) struct ConfigurationView {
    /// As in keys.
    machine: String,
    /// The start of the machine's software that answered.
    boot: String,
    /// Version of its software.
    software: String,
    /// The machine file, TOML, with all defaults.
    machine_file: String,
}

/// What runs on a machine, and how it is configured: the machine itself is asked.
#[utoipa::path(get, path = "/api/v1/machines/{id}/configuration", operation_id = "machine_configuration",
    tag = "fleet",
    params(("id" = String, Path, description = "The machine's id", min_length = 1, max_length = 64)),
    responses((status = OK, body = ConfigurationView),
        (status = NOT_FOUND, body = Problem, content_type = "application/problem+json"),
        (status = SERVICE_UNAVAILABLE, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn configuration(
    State(shared): State<Shared>,
    id: Result<Path<String>, PathRejection>,
) -> Result<Json<ConfigurationView>, Problem> {
    let Path(id) = id.map_err(malformed)?;
    let boot = shared.frame().machine(&id).map(|machine| machine.boot.clone());
    let boot = boot.ok_or_else(|| Problem::not_found("machine", &id))?;
    let unavailable = |reason: &str| {
        Problem::new(StatusCode::SERVICE_UNAVAILABLE, format!("machine \"{id}\" does not tell: {reason}"))
    };
    let run: BootId = boot.parse().map_err(|_| unavailable("it was not heard yet"))?;
    let key = configuration_key(&shared.site, &id, run);
    let answers =
        shared.session.get(key).timeout(PATIENCE).await.map_err(|error| unavailable(&error.to_string()))?;
    let answer = answers.recv_async().await.map_err(|_| unavailable("no answer"))?;
    let sample = answer.into_result().map_err(|_| unavailable("it refuses"))?;
    if sample.payload().len() > ANSWER_BYTES_MAX {
        return Err(unavailable("its answer is too long"));
    }
    let head: JournalHead = serde_json::from_slice(&sample.payload().to_bytes())
        .map_err(|error| unavailable(&format!("its answer cannot be read: {error}")))?;
    let JournalHead { software, machine_file } = head;
    Ok(Json(ConfigurationView { machine: id, boot, software, machine_file }))
}
