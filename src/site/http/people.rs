//! Signing in and out, who one is, one's own password, tickets for WebSockets.

use std::sync::Arc;

use axum::body::Bytes;
use axum::extract::State;
use axum::extract::rejection::BytesRejection;
use axum::http::header::SET_COOKIE;
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use serde::{Deserialize, Serialize};

use super::Shared;
use super::guard::Note;
use super::input::json_needed;
use super::origin::bucket;
use super::problem::Problem;
use super::visitor::{People, TICKET_LIFE, Visitor, cookie};
use crate::accounts::{AccountsError, By, Password, Role, User};
use crate::fleet::UtcTime;

/// Name of the cookie where no proxy speaks HTTPS.
pub(super) const COOKIE: &str = "holdfast";

/// Who wants to sign in.
#[derive(Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct SignIn {
    /// Of the account.
    #[schema(max_length = 64)]
    name: String,
    /// Of the account.
    #[schema(value_type = String, format = Password, max_length = 200)]
    password: Password,
}

/// Who asks, and what it may do.
#[derive(Serialize, utoipa::ToSchema)]
pub(super) struct MeView {
    /// Whether there are accounts. Without any, whoever reaches the server may do everything.
    accounts: bool,
    /// The account; `null` where there are none.
    name: Option<String>,
    /// What it may do now.
    role: Role,
    /// The token that was shown, if one was.
    token: Option<String>,
    /// Until when the token is good.
    #[schema(value_type = Option<String>, format = DateTime)]
    expires: Option<UtcTime>,
}

/// A password for the one before.
#[derive(Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct PasswordChange {
    /// The one before.
    #[schema(value_type = String, format = Password, max_length = 200)]
    old: Password,
    /// From now on: 10 to 200 characters, and not the name.
    #[schema(value_type = String, format = Password, min_length = 10, max_length = 200)]
    new: Password,
}

/// No account's name is longer.
const NAME_MAX: usize = 64;

/// Opens one WebSocket.
#[derive(Serialize, utoipa::ToSchema)]
pub(super) struct TicketView {
    /// To be sent as the parameter `ticket`.
    ticket: String,
    /// It is good for so long, s.
    good_s: f64,
}

/// Signs in: the cookie of the answer is for the browser. Ends the sign-in of a cookie that is sent along.
#[utoipa::path(post, path = "/api/v1/sign-in", tag = "accounts", request_body = SignIn,
    responses(
        (status = OK, body = MeView, headers(("Set-Cookie" = String, description = "The sign-in"))),
        (status = UNAUTHORIZED, description = "Name or password is wrong", body = Problem,
            content_type = "application/problem+json"),
        (status = SERVICE_UNAVAILABLE, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn sign_in(
    State(shared): State<Shared>,
    visitor: Visitor,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    let SignIn { name, password } = json_needed(&headers, body)?;
    if name.chars().count() > NAME_MAX {
        return Err(Problem::new(
            StatusCode::BAD_REQUEST,
            format!("name has more than {NAME_MAX} characters"),
        ));
    }
    let people = &shared.people;
    let Some(user) = verify(people, &visitor, &name, password).await? else {
        // A name that is none may be a password in the wrong field.
        let wanted = name.clone();
        let is_known = ask(people, move |people| Ok(people.accounts.user(&wanted).is_ok())).await?;
        let who = if is_known { name } else { "(unknown)".to_owned() };
        let problem = Problem::unauthorized("name or password is wrong");
        return Ok((Extension(Note::Of(who, "wrong password")), problem).into_response());
    };
    let before = cookie(&headers, people.cookie_name());
    let signed_in = user.name.clone();
    let secret = ask(people, move |people| {
        if let Some(before) = before {
            people.accounts.sign_out(&before)?;
        }
        people.accounts.sign_in(&signed_in, people.limits, people.now())
    })
    .await?;
    let note = Extension(Note::Of(user.name.clone(), "signed in"));
    let me = MeView { accounts: true, name: Some(user.name), role: user.role, token: None, expires: None };
    let life_s = people.limits.total.as_seconds() as u64;
    let cookie = set_cookie(people, secret.reveal(), life_s)?;
    Ok((note, [(SET_COOKIE, cookie)], Json(me)).into_response())
}

/// Ends the sign-in of the cookie, if there is one.
#[utoipa::path(post, path = "/api/v1/sign-out", tag = "accounts",
    responses((status = NO_CONTENT, description = "Signed out")))]
pub(super) async fn sign_out(State(shared): State<Shared>, headers: HeaderMap) -> Result<Response, Problem> {
    let people = &shared.people;
    if let Some(secret) = cookie(&headers, people.cookie_name()) {
        ask(people, move |people| people.accounts.sign_out(&secret)).await?;
    }
    let gone = set_cookie(people, "", 0)?;
    Ok((StatusCode::NO_CONTENT, [(SET_COOKIE, gone)]).into_response())
}

/// Who asks, and what it may do.
#[utoipa::path(get, path = "/api/v1/me", tag = "accounts", responses((status = OK, body = MeView)))]
pub(super) async fn me(visitor: Visitor) -> Result<Json<MeView>, Problem> {
    let role = visitor.role()?;
    let known = visitor.known;
    let (token, expires) = match known.as_ref().map(|known| &known.by) {
        Some(By::Token { id, expires }) => (Some(id.clone()), Some(UtcTime(*expires))),
        _ => (None, None),
    };
    Ok(Json(MeView { accounts: known.is_some(), name: known.map(|known| known.name), role, token, expires }))
}

/// Changes one's own password, and ends all sign-ins of the account.
#[utoipa::path(put, path = "/api/v1/me/password", operation_id = "change_password", tag = "accounts", request_body = PasswordChange,
    responses((status = NO_CONTENT, description = "Changed; sign in anew"),
        (status = CONFLICT, description = "There are no accounts", body = Problem,
            content_type = "application/problem+json"),
        (status = FORBIDDEN, description = "The old password is wrong", body = Problem,
            content_type = "application/problem+json")))]
pub(super) async fn password(
    State(shared): State<Shared>,
    visitor: Visitor,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    let PasswordChange { old, new } = json_needed(&headers, body)?;
    let name = visitor.account()?.name.clone();
    if verify(&shared.people, &visitor, &name, old).await?.is_none() {
        return Err(Problem::new(StatusCode::FORBIDDEN, "the old password is wrong"));
    }
    hash(&shared.people, move |people| people.accounts.set_password(&name, &new)).await?;
    Ok(StatusCode::NO_CONTENT.into_response())
}

/// A ticket with which a program that can send no headers opens one WebSocket: `/api/v1/live?ticket=`.
#[utoipa::path(post, path = "/api/v1/live-ticket", operation_id = "live_ticket", tag = "accounts",
    responses((status = CREATED, body = TicketView)))]
pub(super) async fn ticket(State(shared): State<Shared>, visitor: Visitor) -> Result<Response, Problem> {
    let ticket = shared.people.ticket(&visitor)?.reveal().to_owned();
    let view = TicketView { ticket, good_s: TICKET_LIFE.as_seconds() };
    Ok((StatusCode::CREATED, Extension(Note::Nothing), Json(view)).into_response())
}

/// The account, if the password is right.
async fn verify(
    people: &Arc<People>,
    visitor: &Visitor,
    name: &str,
    password: Password,
) -> Result<Option<User>, Problem> {
    let from = bucket(visitor.from);
    people.may_try(name, &from)?;
    let wanted = name.to_owned();
    let user = hash(people, move |people| people.accounts.check_password(&wanted, &password)).await?;
    if user.is_some() {
        people.was_right(name, &from);
    }
    Ok(user)
}

fn set_cookie(people: &People, value: &str, life_s: u64) -> Result<HeaderValue, Problem> {
    let secure = if people.http.https { "; Secure" } else { "" };
    let name = people.cookie_name();
    let cookie = format!("{name}={value}; Path=/; Max-Age={life_s}; HttpOnly; SameSite=Strict{secure}");
    let mut cookie = HeaderValue::from_str(&cookie)
        .map_err(|_| Problem::new(StatusCode::INTERNAL_SERVER_ERROR, "the cookie cannot be written"))?;
    cookie.set_sensitive(true);
    Ok(cookie)
}

/// Does with the accounts what may wait for the disk.
pub(super) async fn ask<T: Send + 'static>(
    people: &Arc<People>,
    question: impl FnOnce(&People) -> Result<T, AccountsError> + Send + 'static,
) -> Result<T, Problem> {
    let people = Arc::clone(people);
    let answer = tokio::task::spawn_blocking(move || question(&people)).await.map_err(|error| {
        tracing::error!("the accounts cannot be asked: {error}");
        Problem::new(StatusCode::INTERNAL_SERVER_ERROR, "the accounts cannot be asked")
    })?;
    Ok(answer?)
}

/// The same, for what hashes a password: few at once.
pub(super) async fn hash<T: Send + 'static>(
    people: &Arc<People>,
    question: impl FnOnce(&People) -> Result<T, AccountsError> + Send + 'static,
) -> Result<T, Problem> {
    // Never closed. It goes with the work, which goes on when its client does not wait for it.
    let permit = Arc::clone(&people.hashing).acquire_owned().await;
    ask(people, move |people| {
        let _permit = permit;
        question(people)
    })
    .await
}
