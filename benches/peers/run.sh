#!/bin/sh
# Runs our estimator and GTSAM's fixed-lag smoother on the same simulated logs and prints both side by side.
#
#   benches/peers/run.sh [--minutes N]
#
# N bounds the wall clock of GTSAM's run over an hour of data (default 12; 0 leaves the hour out). HOLDFAST names a
# binary that is already built. Needs Python 3.11 or newer with venv, Linux, and PyPI at the first run.
set -eu

repository=$(cd "$(dirname "$0")/../.." && pwd)
target=${CARGO_TARGET_DIR:-"$repository/target"}
out="$target/peers"
mkdir -p "$out"

if [ -z "${HOLDFAST:-}" ]; then
    cargo build --manifest-path "$repository/Cargo.toml" --release --no-default-features
    HOLDFAST="$target/release/holdfast"
fi

if [ ! -x "$out/venv/bin/python" ]; then
    python3 -m venv "$out/venv"
fi
"$out/venv/bin/python" -m pip install --quiet --disable-pip-version-check "gtsam==4.3.0" "numpy>=2,<3"

# One thread for both: nothing in the comparison may run beside it.
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE=1
exec "$out/venv/bin/python" "$repository/benches/peers/gtsam_fixed_lag.py" --holdfast "$HOLDFAST" --out "$out" "$@"
