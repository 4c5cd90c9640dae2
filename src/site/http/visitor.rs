//! Who asks: from the cookie, the token or the ticket that a request shows.

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use axum::extract::FromRequestParts;
use axum::http::header::{AUTHORIZATION, COOKIE as COOKIES, UPGRADE};
use axum::http::request::Parts;
use axum::http::{HeaderMap, Uri};
use tokio::sync::Semaphore;

use super::buckets::Buckets;
use super::problem::Problem;
use crate::accounts::{Accounts, Known, Role, Secret, SignInLimits};
use crate::config;
use crate::site::clock::SiteClock;
use crate::time::{Span, Stamp};

/// A ticket is good for so long.
pub(super) const TICKET_LIFE: Span = Span::from_millis(30_000);
/// What a ticket opens, and nothing else: they are WebSockets, and ask for no more than a viewer.
const SOCKETS: [&str; 2] = ["/api/v1/live", "/foxglove"];
/// Who holds a WebSocket open is looked at so often.
const STILL_EVERY: Duration = Duration::from_secs(2);
/// More tickets at once are refused.
const TICKETS_MAX: usize = 1000;
/// Passwords that are hashed at once: each takes a core and 19 MiB.
const HASHING_MAX: usize = 2;
/// Wrong passwords for one name at once, and how fast more may follow, 1/s.
const WRONG_OF_NAME: (f64, f64) = (10.0, 1.0 / 30.0);
/// Wrong passwords from one address at once, and how fast more may follow, 1/s.
const WRONG_OF_ADDRESS: (f64, f64) = (30.0, 1.0 / 5.0);
/// Seconds' worth of requests that may come at once.
const BURST_S: f64 = 10.0;

/// Who asks.
#[derive(Clone, Debug)]
pub(in crate::site) struct Visitor {
    /// `None` where nobody has an account yet, and for routes that need none.
    pub known: Option<Known>,
    /// What it may do; `None` for routes that need nothing.
    pub role: Option<Role>,
    /// From where.
    pub from: IpAddr,
}

impl Visitor {
    /// Its role. The guard lets nobody without one through to a route that needs one.
    pub fn role(&self) -> Result<Role, Problem> {
        self.role.ok_or_else(|| Problem::unauthorized("sign in first, or show a token"))
    }

    /// The account; where there are none, says how to make one.
    pub fn account(&self) -> Result<&Known, Problem> {
        self.known.as_ref().ok_or_else(|| {
            let detail = "there are no accounts yet: make one with holdfast site user add NAME --role admin";
            Problem::new(axum::http::StatusCode::CONFLICT, detail)
        })
    }
}

impl<S: Send + Sync> FromRequestParts<S> for Visitor {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Problem> {
        // The guard stands before every route and says who asks.
        parts.extensions.get().cloned().ok_or_else(|| Problem::unauthorized("nobody asked who you are"))
    }
}

/// How a visitor showed who it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Shown {
    Nothing,
    Cookie,
    Token,
    Ticket,
}

type Ticket = (Option<Known>, Role, Stamp);

/// The accounts, and what is known of visitors between requests.
#[derive(Debug)]
pub(in crate::site) struct People {
    pub accounts: Accounts,
    pub http: config::Http,
    pub limits: SignInLimits,
    pub hashing: Arc<Semaphore>,
    clock: SiteClock,
    /// By their hash: whose they are, with the role, and until when they are good.
    tickets: Mutex<BTreeMap<[u8; 32], Ticket>>,
    requests: Mutex<Buckets>,
    wrong_of_name: Mutex<Buckets>,
    wrong_of_address: Mutex<Buckets>,
}

impl People {
    pub fn new(accounts: Accounts, http: config::Http, clock: SiteClock) -> Self {
        let limits = SignInLimits {
            idle: Span::from_seconds(60.0 * http.sign_in_idle_min),
            total: Span::from_seconds(86_400.0 * http.sign_in_days),
        };
        let buckets = |(size, per_s)| Mutex::new(Buckets::new(per_s, size));
        Self {
            limits,
            hashing: Arc::new(Semaphore::new(HASHING_MAX)),
            clock,
            tickets: Mutex::default(),
            requests: buckets((BURST_S * http.requests_per_s, http.requests_per_s)),
            wrong_of_name: buckets(WRONG_OF_NAME),
            wrong_of_address: buckets(WRONG_OF_ADDRESS),
            accounts,
            http,
        }
    }

    pub fn now(&self) -> Stamp {
        self.clock.now()
    }

    /// Whether everybody has to say who it is.
    pub fn asks(&self) -> Result<bool, Problem> {
        Ok(self.http.is_reachable() || self.accounts.exist()?)
    }

    /// Takes a request's permit from a client.
    pub fn admit(&self, bucket: &str) -> Result<(), Problem> {
        let permit = lock(&self.requests).take(bucket, self.now());
        permit.map_err(|after_s| Problem::too_many("too many requests", after_s))
    }

    /// Takes the permits to try a password; [`People::was_right`] gives them back.
    pub fn may_try(&self, name: &str, from: &str) -> Result<(), Problem> {
        let now = self.now();
        let (name, problem) =
            (name.to_ascii_lowercase(), |after_s| Problem::too_many("too many wrong passwords", after_s));
        lock(&self.wrong_of_address).take(from, now).map_err(problem)?;
        lock(&self.wrong_of_name).take(&name, now).map_err(|after_s| {
            lock(&self.wrong_of_address).give_back(from, now);
            problem(after_s)
        })
    }

    pub fn was_right(&self, name: &str, from: &str) {
        let now = self.now();
        lock(&self.wrong_of_name).give_back(&name.to_ascii_lowercase(), now);
        lock(&self.wrong_of_address).give_back(from, now);
    }

    /// A ticket that opens one WebSocket for who asks.
    pub fn ticket(&self, visitor: &Visitor) -> Result<Secret, Problem> {
        let role = visitor.role()?;
        let secret = Secret::draw("")?;
        let now = self.now();
        let mut tickets = lock(&self.tickets);
        tickets.retain(|_, (.., expires)| now < *expires);
        if tickets.len() >= TICKETS_MAX {
            return Err(Problem::too_many("too many tickets wait to be used", TICKET_LIFE.as_seconds()));
        }
        tickets.insert(secret.hash(), (visitor.known.clone(), role, now + TICKET_LIFE));
        Ok(secret)
    }

    /// Who asks, and how it showed that; `None` if that is nobody who may.
    ///
    /// # Errors
    /// What is shown is no good, or the accounts cannot be read.
    pub(super) fn recognize(self: &Arc<Self>, headers: &HeaderMap, uri: &Uri) -> Result<Found, Problem> {
        if !self.asks()? {
            return Ok(Some((None, Role::Admin, Shown::Nothing)));
        }
        let now = self.now();
        if let Some(told) = headers.get(AUTHORIZATION) {
            let token = told.to_str().ok().and_then(|told| told.split_once(' '));
            let token = token.filter(|(scheme, _)| scheme.eq_ignore_ascii_case("bearer"));
            let secret = token.map(|(_, token)| Secret::of(token.trim()));
            let known = match &secret {
                Some(secret) => self.accounts.by_token(secret, now)?,
                None => None,
            };
            let (Some(secret), Some((known, is_due))) = (secret, known) else {
                return Err(Problem::unauthorized("the token is not known, has expired or was revoked"));
            };
            self.saw(secret, is_due);
            let role = known.role;
            return Ok(Some((Some(known), role, Shown::Token)));
        }
        if SOCKETS.contains(&uri.path())
            && headers.contains_key(UPGRADE)
            && let Some(ticket) = parameter(uri, "ticket")
        {
            let taken = lock(&self.tickets).remove(&Secret::of(ticket).hash());
            let good = taken.filter(|(.., expires)| now < *expires);
            // Accounts may have been made, or the one that asked removed, since the ticket was given.
            let Some((Some(known), role, _)) = good else {
                return Err(Problem::unauthorized("the ticket is not known, was used or has expired"));
            };
            return match self.accounts.still(&known, self.limits, now)? {
                true => Ok(Some((Some(known), role, Shown::Ticket))),
                false => Err(Problem::unauthorized("who got the ticket is not known any more")),
            };
        }
        let Some(secret) = cookie(headers, self.cookie_name()) else { return Ok(None) };
        let Some((known, is_due)) = self.accounts.signed_in(&secret, self.limits, now)? else {
            return Ok(None);
        };
        self.saw(secret, is_due);
        let role = known.role;
        Ok(Some((Some(known), role, Shown::Cookie)))
    }

    /// Ends when a visitor who was let in would not be let in any more.
    pub async fn gone(&self, visitor: &Visitor) {
        let mut asking = tokio::time::interval(STILL_EVERY);
        loop {
            asking.tick().await;
            if !self.still(visitor) {
                return;
            }
        }
    }

    /// Whether a visitor who was let in would be let in now.
    pub fn still(&self, visitor: &Visitor) -> bool {
        let still = match &visitor.known {
            Some(known) => self.accounts.still(known, self.limits, self.now()).map_err(Problem::from),
            None => self.asks().map(|asks| !asks),
        };
        still.unwrap_or(false)
    }

    /// The cookie's name: browsers let no page without HTTPS, and no other host, set one with that prefix.
    pub fn cookie_name(&self) -> &'static str {
        if self.http.https { "__Host-holdfast" } else { super::people::COOKIE }
    }

    /// Writes down, when that is due, that a secret was used; nobody waits for it.
    fn saw(self: &Arc<Self>, secret: Secret, is_due: bool) {
        if !is_due {
            return;
        }
        let people = Arc::clone(self);
        tokio::task::spawn_blocking(move || {
            if let Err(error) = people.accounts.seen(&secret, people.now()) {
                tracing::warn!("it cannot be written down who was there: {error}");
            }
        });
    }
}

/// Who was recognized, with its role, and by what.
pub(super) type Found = Option<(Option<Known>, Role, Shown)>;

/// A cookie of that name.
pub(super) fn cookie(headers: &HeaderMap, name: &str) -> Option<Secret> {
    let cookies = headers.get_all(COOKIES).iter().filter_map(|value| value.to_str().ok());
    let mut pairs = cookies.flat_map(|value| value.split(';')).filter_map(|pair| pair.trim().split_once('='));
    pairs.find(|(found, _)| *found == name).map(|(_, value)| Secret::of(value))
}

/// A parameter of the query, if it needs no decoding.
fn parameter<'a>(uri: &'a Uri, name: &str) -> Option<&'a str> {
    let mut pairs = uri.query()?.split('&').filter_map(|pair| pair.split_once('='));
    pairs.find(|(found, _)| *found == name).map(|(_, value)| value)
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Whoever died with the lock left whole values behind.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
