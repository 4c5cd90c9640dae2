/**
 * DEVELOPMENT MOCK, not the site: speaks the site's API with made-up excavators, to work on the page's look and its pace.
 *
 * `node dev/mock-site.mjs [--dist DIR] [--port N] [--machines N]`; the end-to-end test uses it for the pace with many
 * machines alone: `--page URL` takes the page from a site that runs. Machine "b" goes through
 * holding, stale and lost in turn, 15 s each.
 * With `--phase lost` the second machine stays in that phase.
 */

import { createHash } from "node:crypto";
import { readFile } from "node:fs/promises";
import { createServer } from "node:http";
import { extname, join, normalize } from "node:path";
import { parseArgs } from "node:util";

const { values: options } = parseArgs({
  options: {
    dist: { type: "string", default: "dist" },
    page: { type: "string" },
    port: { type: "string", default: "8090" },
    phase: { type: "string" },
    machines: { type: "string", default: "2" },
  },
});

const WORLD = { latitude_deg: 47.4801402, longitude_deg: 8.49975325, altitude_m: 474.9 };
const PHASES = ["fixed", "holding", "stale", "lost", "initializing"];
const started_ms = Date.now();
const CSP =
  "default-src 'self'; img-src 'self' data: blob:; worker-src 'self'; connect-src 'self'; style-src 'self'; frame-ancestors 'none'";
const TYPES = {
  ".html": "text/html; charset=utf-8",
  ".js": "text/javascript",
  ".mjs": "text/javascript",
  ".css": "text/css",
  ".svg": "image/svg+xml",
};

const rfc3339 = (time_ms) => new Date(time_ms).toISOString().replace("Z", "000000Z");

function phaseNow(time_ms) {
  if (options.phase !== undefined) return options.phase;
  return PHASES[Math.floor((time_ms - started_ms) / 15_000) % PHASES.length];
}

function sensor(name, rate_hz, seconds, refused = 0, last_refusal = null) {
  return {
    sensor: name,
    rate_hz,
    age_s: 0.4 / rate_hz,
    received: Math.round(rate_hz * seconds),
    refused,
    last_refusal,
  };
}

const IDS = Array.from({ length: Number(options.machines) }, (_, index) =>
  index < 26 ? String.fromCharCode(97 + index) : `m${index}`,
);

/** Beyond the first two, machines work in a field of their own each. */
function machine(id, now_ms) {
  const index = IDS.indexOf(id);
  if (index < 2) return single(id, now_ms);
  const view = single(index % 7 === 3 ? "b" : "a", now_ms + index * 1700);
  const [east, north] = [((index % 10) - 5) * 26, (Math.floor(index / 10) - 2) * 26];
  const move = (position) => position && [position[0] + east, position[1] + north, position[2]];
  const pose = view.pose && {
    ...view.pose,
    position_m: move(view.pose.position_m),
    cabin_position_m: move(view.pose.cabin_position_m),
    chassis_position_m: move(view.pose.chassis_position_m),
  };
  return { ...view, id, name: `Excavator ${index + 1}`, pose };
}

function single(id, now_ms) {
  const phase = id === "a" ? "fixed" : phaseNow(now_ms);
  const phaseStart_ms =
    options.phase === undefined
      ? started_ms + Math.floor((now_ms - started_ms) / 15_000) * 15_000
      : started_ms;
  const inPhase_s = (now_ms - phaseStart_ms) / 1000;
  const frozen = phase === "lost" || phase === "stale";
  const motion_s = ((frozen ? phaseStart_ms : now_ms) - started_ms) / 1000;
  const wave = id === "a" ? 0.35 : 0.22;
  const chassis =
    id === "a"
      ? [6 + 5 * Math.sin(0.11 * motion_s), 3 + 3 * Math.sin(0.22 * motion_s), 0.4]
      : [-9 + 4 * Math.cos(0.13 * motion_s), -4 + 2 * Math.sin(0.13 * motion_s), -0.2];
  const chassisHeading =
    id === "a" ? 70 + 25 * Math.sin(0.11 * motion_s) : 250 + 10 * Math.sin(0.2 * motion_s);
  const heading = chassisHeading + 80 * Math.sin(wave * motion_s);
  const angle = (heading * Math.PI) / 180;
  const position = [chassis[0] + 0.5 * Math.sin(angle), chassis[1] + 0.5 * Math.cos(angle), chassis[2] + 1.5];
  const holding = phase === "holding";
  const sigma = holding ? 0.012 + 0.004 * inPhase_s : 0.006 + 0.001 * Math.sin(motion_s);
  const age_s = frozen ? inPhase_s : 0.03;
  const words = {
    fixed: ["RTK FIXED", "good", "online"],
    holding: [
      `HOLDING 0:${String(Math.floor(inPhase_s)).padStart(2, "0")}, ${(inPhase_s * 0.4).toFixed(1)} m, ${(sigma * 100).toFixed(1)} cm`,
      "warning",
      "online",
    ],
    stale: [`STALE 0:${String(Math.floor(inPhase_s)).padStart(2, "0")}`, "bad", "stale"],
    lost: [`OFFLINE 0:${String(Math.floor(inPhase_s)).padStart(2, "0")}`, "offline", "lost"],
    initializing: ["INITIALIZING: heading: drive a few metres", "warning", "online"],
  };
  const [state_word, severity, presence] = words[phase];
  const seconds = Math.max(1, motion_s);
  const stamp_ns = (now_ms - age_s * 1000) * 1e6;
  return {
    id,
    name: id === "a" ? "Menzi Muck M545, no. 1" : "Liebherr R 914, no. 7",
    presence,
    presence_since: rfc3339(presence === "online" ? started_ms : phaseStart_ms),
    software: "0.1.0",
    boot: id === "a" ? "5d01f3a9c2b77e10" : "91be02447dd3a6f8",
    state_word,
    severity,
    pose:
      phase === "initializing"
        ? null
        : {
            stamp: rfc3339(Math.round(now_ms - age_s * 1000)),
            age_s,
            fresh_s: 0.5,
            position_m: position,
            latitude_deg: WORLD.latitude_deg + position[1] / 111_195,
            longitude_deg: WORLD.longitude_deg + position[0] / 75_350,
            altitude_m: WORLD.altitude_m + position[2],
            cabin_position_m: [chassis[0], chassis[1], chassis[2] + 1],
            heading_deg: ((heading % 360) + 360) % 360,
            heading_sigma_deg: holding ? 0.21 : 0.09,
            chassis_heading_deg: chassisHeading % 360,
            chassis_position_m: chassis,
            speed_mps: frozen ? 0 : 0.45 + 0.3 * Math.sin(0.5 * motion_s),
            position_sigma_m: [sigma, sigma * 0.8, sigma * 1.6],
            ellipse95: { semi_major_m: sigma * 2.45 * 1.1, semi_minor_m: sigma * 1.7, bearing_deg: 38 },
          },
    health: {
      age_s: frozen ? inPhase_s : (now_ms % 1000) / 1000,
      estimate_age_s: 0.004,
      prediction_p99_us: 38,
      report: {
        stamp_ns,
        mode: { holding: "fallback", initializing: "initializing" }[phase] ?? "main",
        waits_for: phase === "initializing" ? "heading: drive a few metres straight ahead" : null,
        gnss: holding ? "silent" : "fixed",
        position_sigma_m: sigma,
        heading_sigma_deg: 0.1,
        worst_test_ratio: 0.31,
        gnss_inflation: [1, 1],
        worst_test_sensor: "gnss_left",
        sensors: [
          sensor("imu", 100, seconds),
          sensor("base_imu", 100, seconds),
          sensor(
            "gnss_left",
            holding ? 0 || 0.1 : 20,
            seconds,
            3,
            "stamp 12.05 s is not after the one before, 12.05 s",
          ),
          sensor("gnss_right", 20, seconds),
          sensor("lidar_odometry", 5, seconds),
          sensor("cabin_turn", 100, seconds),
        ],
        outage:
          id === "a"
            ? {
                start_stamp_ns: (started_ms - 300_000) * 1e6,
                end_stamp_ns: (started_ms - 255_000) * 1e6,
                cause: "degraded",
                travelled_m: 11.4,
                jump_m: 0.018,
              }
            : holding
              ? {
                  start_stamp_ns: phaseStart_ms * 1e6,
                  end_stamp_ns: null,
                  cause: "silent",
                  travelled_m: inPhase_s * 0.4,
                  jump_m: null,
                }
              : null,
        updates: Math.round(20 * seconds),
        update_us: 840,
        gyro_bias: [1e-3, -2e-3, 3e-3],
        accel_bias: [0.01, 0.02, -0.05],
      },
    },
    gnss: {
      state: holding ? "silent" : "fixed",
      since: rfc3339(phaseStart_ms),
      mode: holding ? "fallback" : "main",
      outage: holding
        ? {
            id: "o1",
            cause: "silent",
            start: rfc3339(phaseStart_ms),
            duration_s: inPhase_s,
            travelled_m: inPhase_s * 0.4,
            position_sigma_m: sigma,
            budget: inPhase_s > 5 ? { tolerance_m: 0.1, time_s: 60 - inPhase_s, distance_m: 8 } : null,
          }
        : null,
    },
    link: {
      pose_rate_hz: frozen ? 0 : 99.8,
      received: Math.round(100 * seconds),
      missed: 2,
      refused: 0,
      gaps_open: 0,
      gaps_filled: 2,
      gaps_lost: 0,
      clock_offset_s: 0.0012,
    },
  };
}

function fleet() {
  const now_ms = Date.now();
  return {
    site: {
      id: "site",
      name: "Gravel pit Hard, lot 3",
      time_zone: "Europe/Zurich",
      world: WORLD,
      software: "0.1.0",
    },
    time: rfc3339(now_ms),
    machines: IDS.map((id) => machine(id, now_ms)),
  };
}

function sessions() {
  return {
    next: null,
    recording: { state: "recording", why: null, session: "20261123T050000Z", missed: 0, next_session: null },
    sessions: [
      {
        id: "20261123T050000Z",
        name: "",
        notes: "",
        tags: [],
        state: "recording",
        started: rfc3339(started_ms),
        ended: null,
        bytes: 48_312_554 + (Date.now() - started_ms) * 60,
        messages: 812_331,
        machines: ["a", "b"],
        files: 1,
      },
      {
        id: "20261122T063000Z",
        name: "Trench 4",
        notes: "",
        tags: ["trench"],
        state: "recovered",
        started: rfc3339(started_ms - 80_000_000),
        ended: rfc3339(started_ms - 58_000_000),
        bytes: 1_912_554_022,
        messages: 40_812_331,
        machines: ["a"],
        files: 3,
      },
    ],
  };
}

const server = createServer(async (request, response) => {
  const { pathname } = new URL(request.url, "http://localhost");
  const json = (value) => {
    response.writeHead(200, { "content-type": "application/json" });
    response.end(JSON.stringify(value));
  };
  if (pathname === "/api/v1/fleet") return json(fleet());
  if (pathname === "/api/v1/sessions") return json(sessions());
  if (pathname === "/healthz") return response.end("ok");
  // What lies under the plan is that of the site whose page it is.
  const isGround = ["/api/v1/map", "/api/v1/basemap.pmtiles"].includes(pathname);
  if (pathname.startsWith("/api/") && !(isGround && options.page !== undefined)) {
    const empty = {
      "/api/v1/alerts": { alerts: [], next: null },
      "/api/v1/plan": { features: [] },
      "/api/v1/map": { basemap: null },
    }[pathname];
    const me = { accounts: false, name: null, role: "admin", token: null, expires: null };
    if (pathname === "/api/v1/me") return json(me);
    return empty === undefined ? response.writeHead(404).end() : json(empty);
  }
  if (options.page !== undefined) {
    const { range } = request.headers;
    const passed = await fetch(new URL(pathname, options.page), { headers: range ? { range } : {} });
    const headers = {};
    for (const name of ["content-type", "content-security-policy", "content-range", "etag"])
      if (passed.headers.has(name)) headers[name] = passed.headers.get(name);
    response.writeHead(passed.status, headers);
    return response.end(Buffer.from(await passed.arrayBuffer()));
  }
  const view = /^\/(machines|outages|sessions|alerts|account|sign-in)(\/[^/.]*)?$/.test(pathname);
  const path = normalize(pathname === "/" || view ? "/index.html" : pathname);
  try {
    const content = await readFile(join(options.dist, path));
    response.writeHead(200, {
      "content-type": TYPES[extname(path)] ?? "application/octet-stream",
      "content-security-policy": CSP,
      "x-content-type-options": "nosniff",
    });
    response.end(content);
  } catch {
    response.writeHead(404).end();
  }
});

server.on("upgrade", (request, socket) => {
  const accept = createHash("sha1")
    .update(`${request.headers["sec-websocket-key"]}258EAFA5-E914-47DA-95CA-C5AB0DC85B11`)
    .digest("base64");
  socket.write(
    `HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: ${accept}\r\n\r\n`,
  );
  let seq = 0;
  const send = (value) => socket.write(textFrame(JSON.stringify(value)));
  send({ type: "snapshot", seq, fleet: fleet() });
  const timer = setInterval(() => {
    const { time, machines } = fleet();
    seq += 1;
    send({ type: "delta", seq, time, machines, dropped: 0 });
  }, 100);
  const close = () => clearInterval(timer);
  socket.on("close", close);
  socket.on("error", close);
  socket.on("data", (data) => {
    // Opcode 8 asks to close; what else the page says does not matter here.
    if ((data[0] & 0x0f) === 8) socket.end();
  });
});

/** An unmasked text frame, as a server sends it. */
function textFrame(text) {
  const body = Buffer.from(text);
  if (body.length < 126) return Buffer.concat([Buffer.from([0x81, body.length]), body]);
  if (body.length < 65_536)
    return Buffer.concat([Buffer.from([0x81, 126, body.length >> 8, body.length & 255]), body]);
  const head = Buffer.alloc(10);
  head.set([0x81, 127]);
  head.writeBigUInt64BE(BigInt(body.length), 2);
  return Buffer.concat([head, body]);
}

server.listen(Number(options.port), "127.0.0.1", () => {
  console.log(`development mock at http://127.0.0.1:${server.address().port}`);
});
