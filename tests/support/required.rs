//! Tests that need something from outside: skipped aloud on a workbench, failed where every test is required.

use std::ffi::OsString;

/// The environment variable `name`, which names `what`. Without it, says on stderr that the test does not run;
/// panics if `CI` is set or `HOLDFAST_REQUIRE_ALL` is 1.
pub fn variable(name: &str, what: &str) -> Option<OsString> {
    let value = std::env::var_os(name).filter(|value| !value.is_empty());
    if value.is_none() {
        let ci = std::env::var_os("CI").is_some_and(|value| !value.is_empty() && value != "false");
        let all = std::env::var_os("HOLDFAST_REQUIRE_ALL").is_some_and(|value| value == "1");
        assert!(!ci && !all, "{name} is not set, and every test is required: it must name {what}");
        let thread = std::thread::current();
        // Past the harness, which keeps what a passing test prints to itself.
        use std::io::Write;
        let test = thread.name().unwrap_or("a test");
        let _ = writeln!(std::io::stderr(), "NOT RUN: {test}: {name} is not set; it names {what}");
    }
    value
}
