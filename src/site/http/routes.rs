//! The routes, each with the least role that may use it: there is no way to add one without.
//!
//! What is said of a route here, the guard asks for and the OpenAPI document tells.

use std::collections::BTreeMap;

use axum::Router;
use axum::http::Method;
use axum::routing::MethodRouter;
use utoipa::openapi::path::{Operation, PathItem};
use utoipa::openapi::response::{Response, ResponseBuilder};
use utoipa::openapi::schema::{Schema, SchemaType};
use utoipa::openapi::security::{
    ApiKey, ApiKeyValue, HttpAuthScheme, HttpBuilder, SecurityRequirement, SecurityScheme,
};
use utoipa::openapi::{ContentBuilder, HeaderBuilder, ObjectBuilder, OpenApi, Ref, RefOr, Type};
use utoipa_axum::router::{OpenApiRouter, UtoipaMethodRouter};

use super::Shared;
use super::problem::PROBLEM;
use crate::accounts::Role;

/// Who may use a route.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Need {
    /// Everybody: nothing of the site is in the answer.
    Nothing,
    /// Whoever has this role, or a higher one.
    Least(Role),
}

/// The routes' needs: by path as the router writes it, and method. Who asks for what is not in it is refused.
#[derive(Clone, Debug, Default)]
pub(super) struct Needs(BTreeMap<String, BTreeMap<String, Need>>);

impl Needs {
    /// What the method of a path needs; `None` if the path does not answer to it.
    pub fn of(&self, path: &str, method: &Method) -> Option<Need> {
        // Who answers GET answers HEAD.
        let method = if method == Method::HEAD { &Method::GET } else { method };
        self.0.get(path)?.get(method.as_str()).copied()
    }

    /// All paths.
    #[cfg(test)]
    pub fn paths(&self) -> impl Iterator<Item = &str> {
        self.0.keys().map(String::as_str)
    }

    /// What it needs to know what a path answers to: nothing, if everybody may use it.
    pub fn least(&self, path: &str) -> Need {
        let mut needs = self.0.get(path).into_iter().flat_map(BTreeMap::values);
        if needs.any(|need| *need == Need::Nothing) { Need::Nothing } else { Need::Least(Role::Viewer) }
    }

    /// The methods that a path answers to, as the header `Allow` has them; `None` if there is no such path.
    pub fn allowed(&self, path: &str) -> Option<String> {
        let methods = self.0.get(path)?.keys();
        let names = methods.flat_map(|method| match method.as_str() {
            "GET" => vec!["GET", "HEAD"],
            method => vec![method],
        });
        Some(names.collect::<Vec<_>>().join(", "))
    }
}

/// Routes under construction.
pub(super) struct Routes {
    router: OpenApiRouter<Shared>,
    needs: Needs,
}

impl Routes {
    pub fn new(documentation: OpenApi) -> Self {
        Self { router: OpenApiRouter::with_openapi(documentation), needs: Needs::default() }
    }

    /// Routes for everybody.
    pub fn open(self, routes: UtoipaMethodRouter<Shared>) -> Self {
        self.add(Need::Nothing, routes)
    }

    /// Routes for whoever has an account.
    pub fn viewer(self, routes: UtoipaMethodRouter<Shared>) -> Self {
        self.add(Need::Least(Role::Viewer), routes)
    }

    /// Routes for operators and admins.
    pub fn operator(self, routes: UtoipaMethodRouter<Shared>) -> Self {
        self.add(Need::Least(Role::Operator), routes)
    }

    /// Routes for admins.
    pub fn admin(self, routes: UtoipaMethodRouter<Shared>) -> Self {
        self.add(Need::Least(Role::Admin), routes)
    }

    /// A page for people, for everybody, with which programs have nothing to do: only GET, not in the document.
    pub fn page(mut self, path: &str, page: MethodRouter<Shared>) -> Self {
        self.needs.0.entry(path.to_owned()).or_default().insert("GET".to_owned(), Need::Nothing);
        self.router = self.router.route(path, page);
        self
    }

    fn add(mut self, need: Need, (schemas, mut paths, methods): UtoipaMethodRouter<Shared>) -> Self {
        for (path, item) in &mut paths.paths {
            let needs = self.needs.0.entry(path.clone()).or_default();
            for (method, operation) in operations(item) {
                needs.insert(method.to_owned(), need);
                document(operation, method, need);
            }
        }
        self.router = self.router.routes((schemas, paths, methods));
        self
    }

    pub fn finish(self) -> (Router<Shared>, Needs, OpenApi) {
        let (router, mut documentation) = self.router.split_for_parts();
        let components = documentation.components.get_or_insert_default();
        for (name, response) in problems() {
            components.responses.insert(name.to_owned(), RefOr::T(response));
        }
        let cookie = ApiKeyValue::with_description(super::people::COOKIE, "What POST /api/v1/sign-in gives");
        components.add_security_scheme("session", SecurityScheme::ApiKey(ApiKey::Cookie(cookie)));
        let token = HttpBuilder::new()
            .scheme(HttpAuthScheme::Bearer)
            .description(Some("What POST /api/v1/tokens gives: hf_ and 64 hexadecimal digits"));
        components.add_security_scheme("token", SecurityScheme::Http(token.build()));
        (router, self.needs, documentation)
    }
}

fn operations(item: &mut PathItem) -> impl Iterator<Item = (&'static str, &mut Operation)> {
    [
        ("GET", &mut item.get),
        ("PUT", &mut item.put),
        ("POST", &mut item.post),
        ("DELETE", &mut item.delete),
        ("OPTIONS", &mut item.options),
        ("HEAD", &mut item.head),
        ("PATCH", &mut item.patch),
        ("TRACE", &mut item.trace),
    ]
    .into_iter()
    .filter_map(|(method, operation)| Some((method, operation.as_mut()?)))
}

/// Says of an operation who may use it, and what can go wrong with any of its kind.
fn document(operation: &mut Operation, method: &str, need: Need) {
    let changes = !matches!(method, "GET" | "HEAD");
    let mut known = vec![("400", "Malformed"), ("421", "Misdirected"), ("429", "TooMany"), ("500", "Failed")];
    match need {
        Need::Nothing => operation.security = Some(Vec::new()),
        Need::Least(role) => {
            let of = |scheme: &str| SecurityRequirement::new(scheme, [role.name()]);
            operation.security = Some(vec![of("session"), of("token")]);
            known.extend([("401", "Unknown"), ("503", "Unavailable")]);
        }
    }
    if changes || need == Need::Least(Role::Admin) {
        known.push(("403", "Forbidden"));
    }
    if operation.request_body.is_some() {
        known.extend([("408", "TooSlow"), ("413", "TooLarge"), ("415", "WrongType")]);
    }
    // What is left out is not there: nobody sends a parameter that is `null`.
    for parameter in operation.parameters.iter_mut().flatten() {
        if let RefOr::T(parameter) = parameter
            && let Some(RefOr::T(Schema::Object(schema))) = &mut parameter.schema
            && let SchemaType::Array(types) = &schema.schema_type
            && let Some(only) = types.iter().find(|kind| **kind != Type::Null)
        {
            schema.schema_type = SchemaType::Type(only.clone());
        }
    }
    for (status, name) in known {
        let reference = RefOr::Ref(Ref::from_response_name(name));
        operation.responses.responses.entry(status.to_owned()).or_insert(reference);
    }
}

/// What can go wrong everywhere, by the names that operations refer to.
fn problems() -> impl Iterator<Item = (&'static str, Response)> {
    [
        ("Malformed", "The request is not as it should be", None),
        ("Unknown", "Nobody who is known: sign in, or show a token", Some("WWW-Authenticate")),
        ("Forbidden", "The role does not reach, or the request comes from another origin", None),
        ("TooSlow", "The body did not come in time", None),
        ("TooLarge", "The body is too large", None),
        ("WrongType", "The body has another media type", None),
        ("Misdirected", "The server does not answer to this host name", None),
        ("TooMany", "Too many requests", Some("Retry-After")),
        ("Failed", "A fault of the server", None),
        ("Unavailable", "The server cannot do it now", None),
    ]
    .into_iter()
    .map(|(name, description, header)| {
        let content = ContentBuilder::new().schema(Some(Ref::from_schema_name("Problem"))).build();
        let mut response = ResponseBuilder::new().description(description).content(PROBLEM, content);
        if let Some(header) = header {
            let text = ObjectBuilder::new().schema_type(Type::String);
            response = response.header(header, HeaderBuilder::new().schema(Some(text)).build());
        }
        (name, response.build())
    })
}
