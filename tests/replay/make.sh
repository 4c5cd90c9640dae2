#!/usr/bin/env bash
# Makes the recordings in this folder anew: HOLDFAST=path/to/holdfast bash tests/replay/make.sh
# Takes a minute, and the port 127.0.0.1:17447.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
holdfast=$(realpath "$(command -v "${HOLDFAST:-holdfast}")")
work=$(mktemp -d)
cd "$work" # The recordings tell the machine files: no path of this computer should be in them.
pids=()
trap 'kill -9 "${pids[@]}" 2>/dev/null || true; rm -rf "$work"' EXIT

site() {
    sed -e 's/127.0.0.1:7447/127.0.0.1:17447/' -e 's/"day"/"never"/' "$here/../../config/site.toml" > "$work/site.toml"
    "$holdfast" site --config "$work/site.toml" --data "$work/site" --listen 127.0.0.1:0 > /dev/null 2>> "$work/log" &
    site=$!
    pids+=("$site")
}
machine() {
    "$holdfast" machine --scenario "$here/yard.toml" --machine "yard-$1" --record board \
        --connect tcp/127.0.0.1:17447 2>> "$work/log" &
    machines[$1]=$!
    pids+=("$!")
}
lose() { # PROCESS
    kill -9 "$1"
    wait "$1" 2> /dev/null || true
}
finish() { # NAME
    kill -TERM "${machines[1]}" "${machines[2]}"
    wait "${machines[1]}" "${machines[2]}"
    sleep 1
    kill -TERM "$site"
    wait "$site"
    rm -rf "${here:?}/$1"
    mkdir "$here/$1"
    cp "$work"/site/sessions/*/*.mcap "$here/$1"
    rm -rf "$work/site" "$work/board"
}
declare -a machines

# GNSS lets go of both machines, and the link and all processes are well.
site; sleep 1; machine 1; machine 2; sleep 26
finish outage

# The site dies and comes back, and fetches what it missed; a machine loses its power and starts again.
site; sleep 1; machine 1; machine 2; sleep 9
lose "$site"; sleep 4; site; sleep 5
lose "${machines[2]}"; sleep 1; machine 2; sleep 12
finish restarts
ls -l "$here/outage" "$here/restarts"
