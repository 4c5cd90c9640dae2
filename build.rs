//! Builds the page in `web/` into `$OUT_DIR/web`, from where the site embeds it.
//!
//! Only with feature `shells`: without it, no Node.js is asked for. Installs the page's packages when they are
//! missing or older than `package-lock.json`. Says nothing unless something fails.

use std::env;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use std::time::SystemTime;

/// What the page is made of; a change of anything else does not build it anew.
const SOURCES: [&str; 8] = [
    "index.html",
    "package-lock.json",
    "package.json",
    "public",
    "src",
    "tsconfig.json",
    "vite.config.ts",
    ".npmrc",
];
/// What Vite runs on: 20 from here on, or 22 and later from there on.
const NODE_20_MINOR: u32 = 19;
const NODE_22_MINOR: u32 = 12;
const NODE_ADVICE: &str = "The page of the site server is built with Node.js (20.19 or later, or 22.12 or later) and npm: \
     install them from your system's packages or from nodejs.org, or build without the site server: \
     cargo build --no-default-features";

fn main() -> ExitCode {
    println!("cargo::rerun-if-changed=build.rs");
    if env::var_os("CARGO_FEATURE_SHELLS").is_none() {
        return ExitCode::SUCCESS;
    }
    match build_page() {
        Ok(()) => ExitCode::SUCCESS,
        Err(message) => {
            eprintln!("{message}");
            ExitCode::FAILURE
        }
    }
}

fn build_page() -> Result<(), String> {
    let root = env::var_os("CARGO_MANIFEST_DIR").ok_or("cargo did not set CARGO_MANIFEST_DIR")?;
    let out = env::var_os("OUT_DIR").ok_or("cargo did not set OUT_DIR")?;
    let web = Path::new(&root).join("web");
    for source in SOURCES {
        println!("cargo::rerun-if-changed={}", web.join(source).display());
    }
    check_node()?;
    // Two builds with target directories of their own share the packages: one at a time.
    let lock_path = web.join(".build-lock");
    let lock = File::create(&lock_path).map_err(|error| format!("{}: {error}", lock_path.display()))?;
    lock.lock().map_err(|error| format!("{}: {error}", lock_path.display()))?;
    if !packages_are_current(&web) {
        npm(&web, &["ci", "--include=dev", "--no-audit", "--no-fund", "--prefer-offline"]).map_err(|error| {
            format!(
                "{error}\nThe page's packages could not be installed. npm needs its registry for that, once; \
                 to see it alone: cd web && npm ci"
            )
        })?;
    }
    let target = PathBuf::from(out).join("web");
    let target_name = target.to_str().ok_or_else(|| format!("{} is not Unicode", target.display()))?;
    npm(&web, &["run", "build", "--", "--outDir", target_name, "--emptyOutDir"]).map_err(|error| {
        format!("{error}\nThe page could not be built. To see it alone: cd web && npm run build")
    })?;
    if target.join("index.html").is_file() {
        Ok(())
    } else {
        Err(format!("npm run build left no {}", target.join("index.html").display()))
    }
}

/// Whether the packages were installed after the lock file was last written.
fn packages_are_current(web: &Path) -> bool {
    // npm writes this file last.
    let installed = modified(&web.join("node_modules/.package-lock.json"));
    let wanted = modified(&web.join("package-lock.json"));
    matches!((installed, wanted), (Some(installed), Some(wanted)) if installed >= wanted)
}

fn modified(path: &Path) -> Option<SystemTime> {
    fs::metadata(path).and_then(|metadata| metadata.modified()).ok()
}

fn check_node() -> Result<(), String> {
    let output = Command::new("node")
        .arg("--version")
        .output()
        .map_err(|error| format!("node could not be started: {error}.\n{NODE_ADVICE}"))?;
    let version = String::from_utf8_lossy(&output.stdout).trim().to_owned();
    let mut parts = version.trim_start_matches('v').split('.').map_while(|part| part.parse::<u32>().ok());
    let fits = match (parts.next(), parts.next()) {
        (Some(20), Some(minor)) => minor >= NODE_20_MINOR,
        (Some(22), Some(minor)) => minor >= NODE_22_MINOR,
        (Some(major), Some(_)) => major > 22,
        _ => false,
    };
    if fits { Ok(()) } else { Err(format!("node is {version}, which is too old.\n{NODE_ADVICE}")) }
}

/// Runs npm in `web/`; what it says is told only if it fails.
fn npm(web: &Path, arguments: &[&str]) -> Result<(), String> {
    let program = if cfg!(windows) { "npm.cmd" } else { "npm" };
    let output = Command::new(program)
        .args(arguments)
        .current_dir(web)
        .output()
        .map_err(|error| format!("npm could not be started: {error}.\n{NODE_ADVICE}"))?;
    if output.status.success() {
        return Ok(());
    }
    Err(format!(
        "npm {} failed ({}):\n{}{}",
        arguments.join(" "),
        output.status,
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr),
    ))
}
