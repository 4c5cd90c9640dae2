//! Who may say and hear what at the site's endpoint, by the common names of their certificates.
//!
//! Nothing is allowed but this: a machine publishes, answers and is alive under its own keys, and hears the site's
//! questions; a listener hears every machine. Zenoh checks it on the site's side of each link, in both directions.

use serde_json::{Value, json};

use crate::config::Admitted;

/// Zenoh's `access_control` for a site.
pub(super) fn control(site: &str, admitted: &Admitted) -> Value {
    let all = format!("holdfast/{site}/**");
    let mut rules = vec![
        json!({ "id": "site-asks", "permission": "allow", "flows": ["egress"], "key_exprs": [all],
            "messages": ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query", "query"] }),
        json!({ "id": "listeners-ask", "permission": "allow", "flows": ["ingress"], "key_exprs": [all],
            "messages": ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query"] }),
        json!({ "id": "listeners-hear", "permission": "allow", "flows": ["egress"], "key_exprs": [all],
            "messages": ["put", "delete", "liveliness_token", "reply"] }),
    ];
    let mut subjects = Vec::new();
    let mut policies = Vec::new();
    for machine in &admitted.machines {
        let says = format!("{machine}-says");
        rules.push(json!({ "id": says, "permission": "allow", "flows": ["ingress"],
            "key_exprs": [format!("holdfast/{site}/{machine}/**")],
            "messages": ["put", "delete", "liveliness_token", "declare_queryable", "reply"] }));
        subjects.push(json!({ "id": machine, "cert_common_names": [machine] }));
        policies.push(json!({ "rules": [says, "site-asks"], "subjects": [machine] }));
    }
    for listener in &admitted.listeners {
        subjects.push(json!({ "id": listener, "cert_common_names": [listener] }));
        policies.push(json!({ "rules": ["listeners-ask", "listeners-hear"], "subjects": [listener] }));
    }
    json!({ "enabled": true, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies })
}
