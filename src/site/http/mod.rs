//! The site's HTTP door: API, live WebSocket, metrics, page. Reads the newest frame; asks nothing back.

mod aemp;
mod alerts;
mod api;
mod assets;
mod download;
mod export;
mod foxglove;
mod guard;
mod live;
mod metrics;
mod outages;
mod problem;
mod query;
mod ready;
mod sessions;
pub(super) mod tracks;

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::SyncSender;

use axum::Router;
use axum::http::header::CONTENT_TYPE;
use axum::middleware;
use axum::routing::get;
use axum::serve::ListenerExt as _;
use tokio::net::TcpListener;
use tokio::sync::{Semaphore, mpsc, watch};
use utoipa::OpenApi;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::aggregator::Frame;
use super::alerts::{Acknowledge, Channel};
use super::clock::SiteClock;
use super::counters::Counters;
use super::ended;
use super::foxglove::Feeds;
use super::history::Archive;
use super::sessions::{Catalogue, Command, Progress};
use crate::fleet::Alert;
use crate::frames::geodesy::SiteFrame;
pub(super) use export::turnstile;
use problem::Problem;

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
    pub past: tracks::SharedPast,
    pub archive: Arc<Archive>,
    pub alerts: AlertsDesk,
    /// The site's id.
    pub site: String,
    pub site_frame: SiteFrame,
    pub time_zone: jiff::tz::TimeZone,
    pub clock: SiteClock,
    /// How many exports may be made at once.
    pub exports: Arc<Semaphore>,
    pub stopped: watch::Receiver<bool>,
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
        description = "Where each excavator of a site is. Times are RFC 3339 UTC with nanoseconds; ages are by \
                       the site's clock; units are in the names. Errors are RFC 9457 problem details."
    ),
    tags(
        (name = "fleet", description = "The machines, now"),
        (name = "alerts", description = "What somebody should look at"),
        (name = "outages", description = "When, where and why GNSS failed"),
        (name = "sessions", description = "Recordings"),
        (name = "operation", description = "Of the server itself")
    ),
    components(schemas(Problem, live::LiveMessage, live::Request, outages::OutageState))
)]
struct Documentation;

fn router(shared: Shared) -> Router {
    let documented = OpenApiRouter::with_openapi(Documentation::openapi())
        .routes(routes!(api::fleet))
        .routes(routes!(api::machines))
        .routes(routes!(api::machine))
        .routes(routes!(alerts::list))
        .routes(routes!(alerts::acknowledge))
        .routes(routes!(alerts::test))
        .routes(routes!(outages::list))
        .routes(routes!(outages::statistics))
        .routes(routes!(outages::outage))
        .routes(routes!(outages::shadow_map))
        .routes(routes!(sessions::list, sessions::start))
        .routes(routes!(sessions::session, sessions::edit))
        .routes(routes!(sessions::stop))
        .routes(routes!(download::recording))
        .routes(routes!(tracks::track))
        .routes(routes!(tracks::events))
        .routes(routes!(tracks::history))
        .routes(routes!(export::export))
        .routes(routes!(live::live))
        .routes(routes!(foxglove::foxglove))
        .routes(routes!(aemp::fleet))
        .routes(routes!(ready::healthz))
        .routes(routes!(ready::readyz))
        .routes(routes!(metrics::metrics));
    let (router, documentation) = documented.split_for_parts();
    // Built from constants above; as JSON it always has a form.
    let openapi: Arc<str> = documentation.to_json().unwrap_or_default().into();
    let serve_openapi = move || {
        let openapi = Arc::clone(&openapi);
        async move { ([(CONTENT_TYPE, "application/json")], openapi.to_string()) }
    };
    router
        .route("/api/openapi.json", get(serve_openapi))
        .fallback(assets::serve)
        .method_not_allowed_fallback(problem::method_not_allowed)
        .layer(middleware::from_fn(guard::guard))
        .with_state(shared)
}

/// Serves until `stopped` says so, then ends what is idle and waits for what is under way.
pub(super) async fn serve(listener: TcpListener, shared: Shared, mut stopped: watch::Receiver<bool>) {
    let app = router(shared);
    let listener = listener.tap_io(|stream| {
        if let Err(error) = stream.set_nodelay(true) {
            tracing::debug!("a connection waits to fill its packets: {error}");
        }
    });
    let end = async move { ended(&mut stopped).await };
    if let Err(error) = axum::serve(listener, app).with_graceful_shutdown(end).await {
        tracing::error!("page and API ended: {error}");
    }
}
