#!/usr/bin/env bash
# Runs the tests: Rust, recordings with public tools, web, and the browser against the real demo.
#
#   bash tests/run.sh
#
# A test that wants something that this computer does not have, such as recordings of real drives, says NOT RUN. Those
# are counted at the end; where CI is set, they are failures.
# What is missing is installed where that needs no questions (root on Debian), else named. Python packages go
# into a virtual environment under the target folder, web packages into web/node_modules.
set -euo pipefail
cd "$(dirname "$0")/.."

target=${CARGO_TARGET_DIR:-target}
passed=0
failed=()
said=$(mktemp)
trap 'rm -f "$said"' EXIT

# In the condition of an if, bash goes on after a command that fails, whatever set -e says: what a step runs joins its
# commands with &&.
step() {
    local name=$1
    shift
    printf '\n== %s\n' "$name"
    local begun=$SECONDS
    if "$@"; then
        passed=$((passed + 1))
        printf -- '-- %s: passed in %s s\n' "$name" "$((SECONDS - begun))"
    else
        failed+=("$name")
        printf -- '-- %s: FAILED after %s s\n' "$name" "$((SECONDS - begun))"
    fi
}

missing_packages() {
    command -v cc >/dev/null || echo build-essential
    python3 -c 'import venv, ensurepip' 2>/dev/null || echo python3-venv
    [ -x "${CHROMIUM:-/usr/bin/chromium}" ] || echo chromium
}

prepare() {
    if ! command -v cargo >/dev/null; then
        echo "Rust is missing: install rustup (Debian: apt-get install rustup), then run this again." >&2
        exit 2
    fi
    if ! node -e 'const [a, b] = process.versions.node.split(".").map(Number); process.exit(a > 20 || (a === 20 && b >= 19) ? 0 : 1)' 2>/dev/null; then
        echo "Node 20.19 or newer with npm is missing: install it, then run this again." >&2
        exit 2
    fi
    local packages
    mapfile -t packages < <(missing_packages)
    if [ "${#packages[@]}" -gt 0 ]; then
        if [ "$(id -u)" -eq 0 ] && command -v apt-get >/dev/null; then
            apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq "${packages[@]}" >/dev/null
        else
            echo "Missing: ${packages[*]}. Install them (sudo apt-get install ${packages[*]}), then run this again." >&2
            exit 2
        fi
    fi
}

# Public readers of what we record; pinned, so that a new release of theirs does not fail our tests.
public_tools() {
    local environment=$target/public-tools
    { [ -x "$environment/bin/pip" ] || python3 -m venv "$environment"; } &&
        "$environment/bin/pip" install --quiet --disable-pip-version-check --requirement tests/record/requirements.txt &&
        HOLDFAST_PYTHON=$(realpath --no-symlinks "$environment/bin/python") &&
        export HOLDFAST_PYTHON
}

# Foxglove's own client packages, into a folder of their own: nothing is installed into the source.
foxglove_clients() {
    local folder=$target/foxglove-clients
    mkdir -p "$folder" && cp tests/feeds/package.json tests/feeds/package-lock.json tests/feeds/.npmrc "$folder/" &&
        { [ "$folder/node_modules/.package-lock.json" -nt tests/feeds/package-lock.json ] ||
            (cd "$folder" && npm ci --no-audit --no-fund --silent); } &&
        HOLDFAST_FOXGLOVE=$(realpath "$folder") &&
        export HOLDFAST_FOXGLOVE
}

rust() {
    # Tests say NOT RUN on stderr, past the harness.
    { cargo test --release --locked --no-fail-fast 2>&1 >&3 | tee "$said" >&2; } 3>&1
}

web() {
    (cd web && { [ node_modules -nt package-lock.json ] || npm ci --no-audit --no-fund --silent; } && npm run --silent check)
}

browser() {
    node web/e2e/run.mjs --holdfast "$target/release/holdfast" --screenshots "$target/screenshots"
}

prepare
step "public tools" public_tools
step "foxglove clients" foxglove_clients
step "build" cargo build --release --locked
step "rust" rust
step "web" web
step "browser" browser

printf '\n'
for name in "${failed[@]}"; do printf 'failed: %s\n' "$name"; done
mapfile -t lacking < <(grep '^NOT RUN: ' "$said")
for line in "${lacking[@]}"; do printf '%s\n' "$line"; done
printf '%s steps passed, %s failed; %s tests were not run\n' "$passed" "${#failed[@]}" "${#lacking[@]}"
[ "${#failed[@]}" -eq 0 ]
if [ -n "${CI:-}" ] && [ "$CI" != false ] && [ "${#lacking[@]}" -gt 0 ]; then
    exit 1
fi
