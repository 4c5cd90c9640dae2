//! The machines, on request.

use axum::Json;
use axum::extract::rejection::PathRejection;
use axum::extract::{Path, State};
use serde::Serialize;

use super::Shared;
use super::input::malformed;
use super::problem::Problem;
use crate::fleet::{FleetView, MachineView};

/// All machines.
#[derive(Serialize, utoipa::ToSchema)]
pub(super) struct MachinesView {
    /// In the order of their ids.
    machines: Vec<MachineView>,
}

/// The whole site, as it is now.
#[utoipa::path(get, path = "/api/v1/fleet", tag = "fleet",
    responses((status = OK, body = FleetView)))]
pub(super) async fn fleet(State(shared): State<Shared>) -> Json<FleetView> {
    Json(shared.frame().view.clone())
}

/// All machines, as they are now.
#[utoipa::path(get, path = "/api/v1/machines", tag = "fleet",
    responses((status = OK, body = MachinesView)))]
pub(super) async fn machines(State(shared): State<Shared>) -> Json<MachinesView> {
    Json(MachinesView { machines: shared.frame().view.machines.clone() })
}

/// One machine, as it is now.
#[utoipa::path(get, path = "/api/v1/machines/{id}", tag = "fleet",
    params(("id" = String, Path, description = "The machine's id", min_length = 1, max_length = 64)),
    responses((status = OK, body = MachineView),
        (status = NOT_FOUND, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn machine(
    State(shared): State<Shared>,
    id: Result<Path<String>, PathRejection>,
) -> Result<Json<MachineView>, Problem> {
    let Path(id) = id.map_err(malformed)?;
    shared.frame().machine(&id).cloned().map(Json).ok_or_else(|| Problem::not_found("machine", &id))
}
