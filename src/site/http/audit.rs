//! The book of changes, for admins.

use axum::Json;
use axum::extract::State;
use axum::http::StatusCode;
use serde::{Deserialize, Serialize};

use super::Shared;
use super::input::Parameters;
use super::people::ask;
use super::problem::Problem;
use super::query::limit;
use crate::fleet::UtcTime;

/// Which part of a list.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Page {
    limit: Option<usize>,
    cursor: Option<String>,
}

impl Page {
    /// From where on.
    pub fn cursor(&self) -> Result<Option<&str>, Problem> {
        match self.cursor.as_deref() {
            Some(cursor) if !(1..=64).contains(&cursor.chars().count()) => {
                Err(Problem::new(StatusCode::BAD_REQUEST, "the cursor is none of ours"))
            }
            cursor => Ok(cursor),
        }
    }

    /// How many.
    pub fn limit(&self) -> Result<usize, Problem> {
        limit(self.limit)
    }
}

/// A change that somebody made, or a try to sign in.
#[derive(Serialize, utoipa::ToSchema)]
pub(super) struct ChangeView {
    /// Counts them.
    number: i64,
    /// When.
    #[schema(value_type = String, format = DateTime)]
    time: UtcTime,
    /// Who; empty where nobody has an account.
    who: String,
    /// How that is known: `sign_in`, `token`, `nobody`, `command_line`.
    via: String,
    /// From which address.
    from: String,
    /// What was asked for.
    what: String,
    /// What came of it: a status, or words.
    outcome: String,
}

/// Changes.
#[derive(Serialize, utoipa::ToSchema)]
pub(super) struct ChangesView {
    /// Newest first.
    changes: Vec<ChangeView>,
    /// The cursor of those before; `null` if there are none.
    next: Option<String>,
}

/// Who changed what, when and from where. The newest 100 000 are kept.
#[utoipa::path(get, path = "/api/v1/audit", operation_id = "list_changes", tag = "accounts",
    params(("limit" = Option<u32>, Query, description = "So many at most: 100 if it is left out", minimum = 1,
            maximum = 1000),
        ("cursor" = Option<String>, Query, description = "`next` of the answer before", pattern = "^[0-9]{1,18}$")),
    responses((status = OK, body = ChangesView)))]
pub(super) async fn list(
    State(shared): State<Shared>,
    Parameters(page): Parameters<Page>,
) -> Result<Json<ChangesView>, Problem> {
    let limit = page.limit()?;
    let before = match page.cursor()? {
        None => None,
        Some(cursor) if cursor.len() <= 18 && cursor.bytes().all(|byte| byte.is_ascii_digit()) => {
            cursor.parse::<i64>().ok()
        }
        Some(_) => return Err(Problem::new(StatusCode::BAD_REQUEST, "the cursor is none of ours")),
    };
    let changes = ask(&shared.people, move |people| people.accounts.changes(before, limit)).await?;
    let next = changes.last().filter(|(number, _)| changes.len() == limit && *number > 1);
    let next = next.map(|(number, _)| number.to_string());
    let changes = changes.into_iter().map(|(number, change)| ChangeView {
        number,
        time: UtcTime(change.time),
        who: change.who,
        via: change.via,
        from: change.from,
        what: change.what,
        outcome: change.outcome,
    });
    Ok(Json(ChangesView { changes: changes.collect(), next }))
}
