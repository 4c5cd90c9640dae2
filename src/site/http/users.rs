//! Accounts, for admins.

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
use super::people::{ask, hash};
use super::problem::Problem;
use super::visitor::Visitor;
use crate::accounts::{Password, Role, User};
use crate::fleet::UtcTime;

/// An account.
#[derive(Serialize, utoipa::ToSchema)]
pub(super) struct UserView {
    /// By which it signs in.
    name: String,
    /// What it may do.
    role: Role,
    /// When it was made.
    #[schema(value_type = String, format = DateTime)]
    created: UtcTime,
}

/// All accounts.
#[derive(Serialize, utoipa::ToSchema)]
pub(super) struct UsersView {
    /// In the order of their names.
    users: Vec<UserView>,
}

/// An account that is to be made.
#[derive(Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct NewUser {
    /// Letters, digits, '.', '_', '@' and '-'; its case does not matter.
    #[schema(min_length = 1, max_length = 64, pattern = "^[A-Za-z0-9][A-Za-z0-9._@-]*$")]
    name: String,
    role: Role,
    /// 10 to 200 characters, and not the name.
    #[schema(value_type = String, format = Password, min_length = 10, max_length = 200)]
    password: Password,
}

/// What is to be changed of an account; what is left out stays as it is.
#[derive(Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct UserChange {
    #[serde(default)]
    role: Option<Role>,
    /// 10 to 200 characters, and not the name. Ends all sign-ins of the account.
    #[serde(default)]
    #[schema(value_type = Option<String>, format = Password, min_length = 10, max_length = 200)]
    password: Option<Password>,
}

impl From<User> for UserView {
    fn from(user: User) -> Self {
        Self { name: user.name, role: user.role, created: UtcTime(user.created) }
    }
}

/// All accounts.
#[utoipa::path(get, path = "/api/v1/users", operation_id = "list_users", tag = "accounts", responses((status = OK, body = UsersView)))]
pub(super) async fn list(State(shared): State<Shared>) -> Result<Json<UsersView>, Problem> {
    let users = ask(&shared.people, |people| people.accounts.users()).await?;
    Ok(Json(UsersView { users: users.into_iter().map(UserView::from).collect() }))
}

/// Makes an account.
#[utoipa::path(post, path = "/api/v1/users", operation_id = "add_user", tag = "accounts", request_body = NewUser,
    responses(
        (status = CREATED, body = UserView, headers(("Location" = String, description = "The account"))),
        (status = CONFLICT, description = "The name is taken, or there are no accounts yet: the first is made on \
            the command line", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn add(
    State(shared): State<Shared>,
    visitor: Visitor,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    let NewUser { name, role, password } = json_needed(&headers, body)?;
    visitor.account()?;
    let user =
        hash(&shared.people, move |people| people.accounts.add_user(&name, role, &password, people.now()))
            .await?;
    let note = Extension(Note::Says(format!("{} as {}", user.name, user.role.name())));
    let location = [(LOCATION, format!("/api/v1/users/{}", user.name))];
    Ok((StatusCode::CREATED, note, location, Json(UserView::from(user))).into_response())
}

/// Changes role or password of an account. The only admin stays one.
#[utoipa::path(patch, path = "/api/v1/users/{name}", operation_id = "edit_user", tag = "accounts",
    params(("name" = String, Path, description = "Of the account", min_length = 1, max_length = 64)),
    request_body = UserChange,
    responses((status = OK, body = UserView),
        (status = NOT_FOUND, body = Problem, content_type = "application/problem+json"),
        (status = CONFLICT, description = "It is the only admin", body = Problem,
            content_type = "application/problem+json")))]
pub(super) async fn edit(
    State(shared): State<Shared>,
    visitor: Visitor,
    name: Result<Path<String>, PathRejection>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    let Path(name) = name.map_err(malformed)?;
    let UserChange { role, password } = json_needed(&headers, body)?;
    visitor.account()?;
    let mut says = Vec::new();
    says.extend(role.map(|role| format!("role {}", role.name())));
    says.extend(password.is_some().then(|| "password".to_owned()));
    let user = hash(&shared.people, move |people| {
        // Both or nothing: what can be refused comes first.
        if let Some(password) = &password {
            people.accounts.check_new_password(&name, password)?;
        }
        if let Some(role) = role {
            people.accounts.set_role(&name, role, true)?;
        }
        if let Some(password) = &password {
            people.accounts.set_password(&name, password)?;
        }
        people.accounts.user(&name)
    })
    .await?;
    Ok((Extension(Note::Says(says.join(", "))), Json(UserView::from(user))).into_response())
}

/// Removes an account with its tokens and sign-ins. The only admin stays.
#[utoipa::path(delete, path = "/api/v1/users/{name}", operation_id = "remove_user", tag = "accounts",
    params(("name" = String, Path, description = "Of the account", min_length = 1, max_length = 64)),
    responses((status = NO_CONTENT, description = "It is gone"),
        (status = NOT_FOUND, body = Problem, content_type = "application/problem+json"),
        (status = CONFLICT, description = "It is the only admin", body = Problem,
            content_type = "application/problem+json")))]
pub(super) async fn remove(
    State(shared): State<Shared>,
    visitor: Visitor,
    name: Result<Path<String>, PathRejection>,
) -> Result<StatusCode, Problem> {
    let Path(name) = name.map_err(malformed)?;
    visitor.account()?;
    ask(&shared.people, move |people| people.accounts.remove_user(&name, true)).await?;
    Ok(StatusCode::NO_CONTENT)
}
