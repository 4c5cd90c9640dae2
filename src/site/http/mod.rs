//! The site's HTTP door: API, live WebSocket, metrics, page. Reads the newest frame; asks nothing back.

mod accept;
mod aemp;
mod alerts;
mod api;
mod assets;
mod audit;
mod basemap;
mod buckets;
mod configuration;
mod docs;
mod door;
mod download;
mod export;
mod foxglove;
mod guard;
mod hour;
mod input;
mod live;
mod metrics;
mod origin;
mod outages;
mod people;
mod place;
mod plan;
mod problem;
mod query;
mod ranges;
mod ready;
mod routes;
mod sessions;
#[cfg(test)]
mod tests;
mod tokens;
mod tracks;
mod trajectory;
mod users;
mod visitor;

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::SyncSender;

use axum::extract::DefaultBodyLimit;
use axum::routing::get;
use axum::{Extension, Router, middleware};
use tokio::net::TcpListener;
use tokio::sync::{Semaphore, mpsc, watch};
use utoipa::OpenApi;
use utoipa_axum::router::UtoipaMethodRouterExt as _;
use utoipa_axum::routes;

use super::aggregator::Frame;
use super::alerts::{Acknowledge, Channel};
use super::clock::SiteClock;
use super::counters::Counters;
use super::foxglove::Feeds;
use super::history::Archive;
use super::sessions::{Catalogue, Command, Progress};
use crate::config;
use crate::fleet::Alert;
use crate::frames::geodesy::SiteFrame;
pub(super) use basemap::Basemap;
pub(super) use export::turnstile;
pub(super) use hour::Hour;
pub(super) use plan::Plan;
use problem::Problem;
use routes::{Needs, Routes};
pub(super) use visitor::People;

/// What the handlers see of the site.
#[derive(Clone)]
pub(super) struct Shared {
    pub frames: watch::Receiver<Arc<Frame>>,
    pub feeds: Feeds,
    pub counters: Arc<Counters>,
    pub catalogue: Arc<Catalogue>,
    pub session: zenoh::Session,
    /// `None` where nothing is recorded.
    pub record_directory: Option<PathBuf>,
    pub recorder: Option<watch::Receiver<Progress>>,
    pub recorder_inbox: Option<SyncSender<Command>>,
    /// The last hour.
    pub hour: hour::Hour,
    pub archive: Arc<Archive>,
    pub alerts: AlertsDesk,
    /// The site's id.
    pub site: String,
    pub site_frame: SiteFrame,
    pub equipment: Arc<[config::Equipment]>,
    pub time_zone: jiff::tz::TimeZone,
    pub clock: SiteClock,
    /// How many exports may be made at once.
    pub exports: Arc<Semaphore>,
    pub stopped: watch::Receiver<bool>,
    pub people: Arc<People>,
    pub plan: Plan,
    /// `None` where the site file names none.
    pub basemap: Option<Arc<Basemap>>,
}

/// What the handlers see of the alerts.
#[derive(Clone)]
pub(super) struct AlertsDesk {
    pub open: watch::Receiver<Arc<Vec<Alert>>>,
    pub commands: mpsc::Sender<Acknowledge>,
    pub channels: Arc<Vec<Channel>>,
}

impl Shared {
    fn frame(&self) -> Arc<Frame> {
        Arc::clone(&self.frames.borrow())
    }

    fn progress(&self) -> Option<Progress> {
        self.recorder.as_ref().map(|recorder| recorder.borrow().clone())
    }
}

#[derive(OpenApi)]
#[openapi(
    info(
        title = "holdfast site",
        license(name = "MIT OR Apache-2.0", identifier = "MIT OR Apache-2.0"),
        description = "Where each excavator of a site is. Times are RFC 3339 UTC with nanoseconds; ages are by \
                       the site's clock; units are in the names. Errors are RFC 9457 problem details."
    ),
    tags(
        (name = "fleet", description = "The machines, now"),
        (name = "alerts", description = "What somebody should look at"),
        (name = "outages", description = "When, where and why GNSS failed"),
        (name = "sessions", description = "Recordings"),
        (name = "accounts", description = "Who may do what. As long as there are no accounts, and only this \
                                           computer reaches the server, nobody is asked"),
        (name = "operation", description = "Of the server itself")
    ),
    components(schemas(Problem, live::LiveMessage, live::Request, outages::OutageState))
)]
struct Documentation;

/// All routes, each with the least role that may use it.
fn routes() -> Routes {
    let plan_body = DefaultBodyLimit::max(plan::PLAN_BYTES_MAX);
    Routes::new(Documentation::openapi())
        .viewer(routes!(api::fleet))
        .viewer(routes!(api::machines))
        .viewer(routes!(api::machine))
        .viewer(routes!(trajectory::trajectory))
        .viewer(routes!(live::live))
        .viewer(routes!(plan::plan))
        .admin(routes!(plan::put).layer(plan_body))
        .viewer(routes!(basemap::map))
        .viewer(routes!(basemap::basemap))
        .viewer(routes!(alerts::list))
        .operator(routes!(alerts::acknowledge))
        .operator(routes!(alerts::test))
        .viewer(routes!(outages::list))
        .viewer(routes!(outages::statistics))
        .viewer(routes!(outages::outage))
        .viewer(routes!(outages::shadow_map))
        .viewer(routes!(sessions::list))
        .operator(routes!(sessions::start))
        .viewer(routes!(sessions::session))
        .operator(routes!(sessions::edit))
        .operator(routes!(sessions::stop))
        .viewer(routes!(download::recording))
        .viewer(routes!(tracks::track))
        .viewer(routes!(tracks::events))
        .viewer(routes!(hour::history))
        .viewer(routes!(configuration::configuration))
        .viewer(routes!(export::export))
        .viewer(routes!(foxglove::foxglove))
        .viewer(routes!(aemp::fleet))
        .open(routes!(people::sign_in))
        .viewer(routes!(people::sign_out))
        .viewer(routes!(people::me))
        .viewer(routes!(people::password))
        .viewer(routes!(people::ticket))
        .viewer(routes!(tokens::list, tokens::add))
        .viewer(routes!(tokens::revoke))
        .admin(routes!(users::list, users::add))
        .admin(routes!(users::edit, users::remove))
        .admin(routes!(audit::list))
        .open(routes!(ready::healthz))
        .open(routes!(ready::readyz))
        .viewer(routes!(metrics::metrics))
        .viewer(routes!(docs::openapi))
        .page("/api/docs", get(docs::begin))
        .page("/api/docs/", get(docs::index))
        .page("/api/docs/{file}", get(docs::asset))
}

/// Everything between the socket and the handlers.
fn router(shared: Shared) -> Router {
    let (router, needs, document) = routes().finish();
    dress(router, needs, &document, shared)
}

fn dress(
    router: Router<Shared>,
    needs: Needs,
    document: &utoipa::openapi::OpenApi,
    shared: Shared,
) -> Router {
    // Built from constants; as JSON it always has a form.
    let document = docs::Document(document.to_json().unwrap_or_default().into());
    let gate = guard::Gate { people: Arc::clone(&shared.people), needs: Arc::new(needs) };
    router
        .fallback(assets::serve)
        .layer(DefaultBodyLimit::max(input::BODY_BYTES_MAX))
        .layer(Extension(document))
        .layer(middleware::from_fn_with_state(gate, guard::guard))
        .with_state(shared)
}

/// Serves until `stopped` says so, then ends what is idle and waits for what is under way.
pub(super) async fn serve(listener: TcpListener, shared: Shared, stopped: watch::Receiver<bool>) {
    let people = Arc::clone(&shared.people);
    door::serve(listener, router(shared), &people.http.proxies, stopped).await;
}
