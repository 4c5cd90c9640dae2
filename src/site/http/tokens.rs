//! Tokens of programs: one's own, and for admins everybody's.

use axum::body::Bytes;
use axum::extract::rejection::{BytesRejection, PathRejection};
use axum::extract::{Path, State};
use axum::http::header::LOCATION;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use serde::{Deserialize, Serialize};

use super::Shared;
use super::guard::Note;
use super::input::{json_needed, malformed};
use super::people::ask;
use super::problem::Problem;
use super::visitor::Visitor;
use crate::accounts::{By, Role, TOKEN_DAYS_MAX, Token};
use crate::fleet::UtcTime;
use crate::time::Span;

/// Good for so many days if nobody says for how many.
const DAYS_DEFAULT: u32 = 90;

/// A token, without its secret.
#[derive(Serialize, utoipa::ToSchema)]
pub(super) struct TokenView {
    /// By which it is revoked.
    id: String,
    /// Whose it is.
    user: String,
    /// What it is for.
    label: String,
    /// What it may do, as long as its account may.
    role: Role,
    /// When it was made.
    #[schema(value_type = String, format = DateTime)]
    created: UtcTime,
    /// Until when it is good.
    #[schema(value_type = String, format = DateTime)]
    expires: UtcTime,
    /// When it was last used, to a minute; `null` if never.
    #[schema(value_type = Option<String>, format = DateTime)]
    seen: Option<UtcTime>,
}

/// Tokens.
#[derive(Serialize, utoipa::ToSchema)]
pub(super) struct TokensView {
    /// In the order of their accounts, then of age.
    tokens: Vec<TokenView>,
}

/// A token that is to be made.
#[derive(Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct NewToken {
    /// What it is for.
    #[schema(min_length = 1, max_length = 100, pattern = "^[A-Za-z0-9 ._@/:+-]*$")]
    label: String,
    /// What it may do: not more than who makes it. Viewer if it is left out.
    #[serde(default)]
    role: Option<Role>,
    /// Good for so many days: 90 if it is left out. One that is made with a token ends with that at the latest.
    #[serde(default)]
    #[schema(minimum = 1, maximum = 3660)]
    days: Option<u32>,
    /// Whose it is to be: one's own if it is left out. For admins only.
    #[serde(default)]
    #[schema(max_length = 64)]
    user: Option<String>,
}

/// A new token with its secret, which is shown this once.
#[derive(Serialize, utoipa::ToSchema)]
pub(super) struct NewTokenView {
    /// To be sent as `Authorization: Bearer`.
    secret: String,
    token: TokenView,
}

impl From<Token> for TokenView {
    fn from(token: Token) -> Self {
        Self {
            id: token.id,
            user: token.user,
            label: token.label,
            role: token.role,
            created: UtcTime(token.created),
            expires: UtcTime(token.expires),
            seen: token.seen.map(UtcTime),
        }
    }
}

/// One's own tokens; for admins those of all.
#[utoipa::path(get, path = "/api/v1/tokens", operation_id = "list_tokens", tag = "accounts", responses((status = OK, body = TokensView)))]
pub(super) async fn list(
    State(shared): State<Shared>,
    visitor: Visitor,
) -> Result<Json<TokensView>, Problem> {
    let whose = whose(&visitor)?;
    let tokens = ask(&shared.people, move |people| people.accounts.tokens(whose.as_deref())).await?;
    Ok(Json(TokensView { tokens: tokens.into_iter().map(TokenView::from).collect() }))
}

/// Makes a token. Its secret is in this answer only.
#[utoipa::path(post, path = "/api/v1/tokens", operation_id = "add_token", tag = "accounts", request_body = NewToken,
    responses(
        (status = CREATED, body = NewTokenView, headers(("Location" = String, description = "The token"))),
        (status = NOT_FOUND, description = "There is no such account", body = Problem,
            content_type = "application/problem+json"),
        (status = CONFLICT, description = "There are no accounts", body = Problem,
            content_type = "application/problem+json")))]
pub(super) async fn add(
    State(shared): State<Shared>,
    visitor: Visitor,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    let NewToken { label, role, days, user } = json_needed(&headers, body)?;
    let account = visitor.account()?.clone();
    let role = role.unwrap_or(Role::Viewer);
    let forbidden = |detail: &str| Err(Problem::new(StatusCode::FORBIDDEN, detail));
    if role > account.role {
        return forbidden("a token may not do more than who makes it");
    }
    let user = user.unwrap_or_else(|| account.name.clone());
    if account.role < Role::Admin && !user.eq_ignore_ascii_case(&account.name) {
        return forbidden("tokens of others are for admins");
    }
    let days = days.unwrap_or(DAYS_DEFAULT);
    if !(1..=TOKEN_DAYS_MAX).contains(&days) {
        let detail = format!("days is {days}, must be from 1 to {TOKEN_DAYS_MAX}");
        return Err(Problem::new(StatusCode::BAD_REQUEST, detail));
    }
    let now = shared.people.now();
    let mut expires = now + Span::from_seconds(86_400.0 * f64::from(days));
    if let By::Token { expires: end, .. } = account.by {
        expires = expires.min(end);
    }
    let (token, secret) =
        ask(&shared.people, move |people| people.accounts.add_token(&user, &label, role, expires, now))
            .await?;
    let note = format!("{} of {} as {}: {}", token.id, token.user, token.role.name(), token.label);
    let location = [(LOCATION, format!("/api/v1/tokens/{}", token.id))];
    let view = NewTokenView { secret: secret.reveal().to_owned(), token: token.into() };
    Ok((StatusCode::CREATED, Extension(Note::Says(note)), location, Json(view)).into_response())
}

/// Revokes a token: one's own, or as admin anybody's.
#[utoipa::path(delete, path = "/api/v1/tokens/{id}", operation_id = "revoke_token", tag = "accounts",
    params(("id" = String, Path, description = "The token's id", min_length = 1, max_length = 64)),
    responses((status = NO_CONTENT, description = "It is good no more"),
        (status = NOT_FOUND, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn revoke(
    State(shared): State<Shared>,
    visitor: Visitor,
    id: Result<Path<String>, PathRejection>,
) -> Result<StatusCode, Problem> {
    let Path(id) = id.map_err(malformed)?;
    let whose = whose(&visitor)?;
    ask(&shared.people, move |people| people.accounts.revoke_token(&id, whose.as_deref())).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// Whose tokens a visitor sees: `None` if everybody's.
fn whose(visitor: &Visitor) -> Result<Option<String>, Problem> {
    let own = || visitor.known.as_ref().map(|known| known.name.clone());
    Ok(if visitor.role()? == Role::Admin { None } else { own() })
}
