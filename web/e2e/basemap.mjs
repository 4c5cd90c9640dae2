/**
 * A basemap under the plan: a site of its own with one machine and a PMTiles file whose every pixel is known.
 *
 * Where a pixel of the plan is on Earth is told by the labels of the plan's grid and by the site's API, not by the
 * code that draws the tiles.
 */

import { spawn } from "node:child_process";
import { mkdir, readFile, writeFile } from "node:fs/promises";
import { join } from "node:path";
import { fileURLToPath } from "node:url";

import { withTimeout } from "./demo.mjs";
import { fiftyMachines } from "./pace.mjs";
import { Watched } from "./page.mjs";
import { BLOCKS, colourOf, makePmtiles, tileOf } from "./pmtiles.mjs";

const CONFIG = new URL("../../config/", import.meta.url);
const ZOOM = 20;
const START_WITHIN_MS = 10_000;
const POSE_WITHIN_MS = 60_000;
const DRAWN_WITHIN_MS = 15_000;
const END_WITHIN_MS = 15_000;
/** Colours of the plan's bare ground, and how much of the basemap is seen over it in the dark. */
const GROUND = { light: [0xee, 0xf1, 0xf0], dark: [0x14, 0x19, 0x1b] };
const SEEN_IN_THE_DARK = 0.5;
/** On a circle so wide around a machine there is nothing of it but its boom and its tail. */
const AROUND_M = 9;

export async function basemap({ checks, browser, binary, data, screenshots, noFindings, nothing, origin }) {
  await checks.check("a site without a basemap offers none", async () => {
    const bare = await Watched.open(browser, origin);
    await bare.answered((url) => url.endsWith("/api/v1/map"));
    await bare.page.locator(".label[data-machine] .label-chip").first().waitFor({ timeout: 10_000 });
    const offered = await bare.page.getByRole("button", { name: "Basemap" }).count();
    await bare.close();
    return offered === 0;
  });
  const site = new SiteWithMap(binary, join(data, "basemap"));
  let watched = null;
  try {
    let address = null;
    await checks.check("a site with a basemap starts", async () => {
      address = await site.start();
    });
    if (address === null) return;
    watched = await Watched.open(browser, address);
    await shown({ checks, watched, address, screenshots, noFindings });
    await hidden({ checks, watched, address });
    await failing({ checks, browser, address });
    await checks.check("50 machines at 10 Hz above it: still at least 30 frames a second", async () => {
      const pace = await fiftyMachines(browser, address);
      console.log(`        ${JSON.stringify(pace)}`);
      return pace.fps >= 30;
    });
    for (const [what, found] of [
      ["no request leaves the origin", watched.foreign],
      ["no errors on the console, none of the security policy", watched.complaints],
    ]) {
      await checks.check(`${what} (basemap)`, () => nothing(found));
    }
    await watched.close();
    await checks.check("the site with the basemap ends in order", () => site.end());
  } catch (error) {
    console.error(site.output);
    throw error;
  } finally {
    site.destroy();
  }
}

async function shown({ checks, watched, address, screenshots, noFindings }) {
  const { page } = watched;
  await checks.check("the machine's place has the colour that the file has there", async () => {
    await page.locator(".label[data-machine] .label-chip").waitFor({ timeout: POSE_WITHIN_MS });
    const { around, everywhere } = await until(
      () => compare(page, address, "light"),
      ({ around, everywhere }) =>
        around.right >= 0.75 * around.asked &&
        around.asked >= 8 &&
        everywhere.right > 0.85 * everywhere.asked,
      DRAWN_WITHIN_MS,
    );
    console.log(
      `        around the machine ${around.right} of ${around.asked}, everywhere ${everywhere.right} of ${everywhere.asked}`,
    );
  });
  await checks.check("also further out, on coarser tiles, and further in", async () => {
    for (const [name, presses] of [
      ["Zoom out", 3],
      ["Zoom in", 4],
    ]) {
      for (let press = 0; press < presses; press += 1) {
        await page.getByRole("button", { name, exact: true }).click();
      }
      await until(
        () => compare(page, address, "light"),
        ({ everywhere }) => everywhere.asked > 20 && everywhere.right > 0.85 * everywhere.asked,
        DRAWN_WITHIN_MS,
      );
    }
    await page.getByRole("button", { name: "Fit all" }).click();
  });
  await checks.check("who made it is named, in plain text", async () => {
    const said = await page.locator(".plan-attribution").innerText();
    if (said !== "© The makers of the test") throw new Error(said);
  });
  await checks.check("axe has no serious findings: basemap", () => noFindings(watched));
  await watched.screenshot(screenshots, "basemap");
  await checks.check("it is dimmed in the dark", async () => {
    await page.emulateMedia({ colorScheme: "dark" });
    await until(
      () => compare(page, address, "dark"),
      ({ everywhere }) => everywhere.right > 0.85 * everywhere.asked,
      DRAWN_WITHIN_MS,
    );
    await page.emulateMedia({ colorScheme: "light" });
  });
  await checks.check("it is not printed", async () => {
    await page.emulateMedia({ media: "print" });
    await until(
      () => groundShare(page),
      (share) => share > 0.7,
      DRAWN_WITHIN_MS,
    );
    await page.emulateMedia({ media: "screen" });
    await until(
      () => groundShare(page),
      (share) => share < 0.1,
      DRAWN_WITHIN_MS,
    );
  });
}

async function hidden({ checks, watched, address }) {
  const { page } = watched;
  const button = page.getByRole("button", { name: "Basemap", exact: true });
  const isBare = () =>
    until(
      () => groundShare(page),
      (share) => share > 0.7,
      DRAWN_WITHIN_MS,
    );
  await checks.check("switched off, the ground is bare and nobody is named", async () => {
    await button.click();
    await isBare();
    return (await page.locator(".plan-attribution").count()) === 0;
  });
  await checks.check("that is remembered, and nothing is asked for while it is so", async () => {
    const asked = [];
    page.on("request", (request) => {
      if (/basemap/.test(new URL(request.url()).pathname)) asked.push(request.url());
    });
    await page.reload();
    await page.locator(".label[data-machine] .label-chip").waitFor({ timeout: 15_000 });
    await button.waitFor({ timeout: 5_000 });
    await isBare();
    if ((await button.getAttribute("aria-pressed")) !== "false") throw new Error("it is switched on");
    if (asked.length > 0) throw new Error(asked.join("\n"));
  });
  await checks.check("switched on again, it is back", async () => {
    await button.click();
    await until(
      () => compare(page, address, "light"),
      ({ everywhere }) => everywhere.right > 0.85 * everywhere.asked,
      DRAWN_WITHIN_MS,
    );
  });
}

/** On a page of its own: what fails is told on the console as well. */
async function failing({ checks, browser, address }) {
  const other = await Watched.open(browser, address, { path: "/alerts" });
  const { page } = other;
  await checks.check("where it cannot be read, that is said once, and the plan goes on without", async () => {
    await page.route("**/basemap.pmtiles", (route) =>
      route.fulfill({
        status: 500,
        contentType: "application/problem+json",
        body: '{"detail":"the disk is gone"}',
      }),
    );
    await page.getByRole("navigation").getByRole("link", { name: "Live" }).click();
    await page.getByText("Basemap: the disk is gone").waitFor({ timeout: 10_000 });
    await page.locator(".label[data-machine] .label-chip").waitFor({ timeout: 10_000 });
    if ((await page.locator("[data-said=basemap]").count()) !== 1) throw new Error("it is not said once");
    await until(
      () => groundShare(page),
      (share) => share > 0.7,
      DRAWN_WITHIN_MS,
    );
  });
  await checks.check("it comes when it can be read again", async () => {
    await page.unroute("**/basemap.pmtiles");
    const button = page.getByRole("button", { name: "Basemap", exact: true });
    await button.click();
    await button.click();
    await until(
      () => groundShare(page),
      (share) => share < 0.1,
      DRAWN_WITHIN_MS,
    );
    return (await page.locator("[data-said=basemap]").count()) === 0;
  });
  await other.close();
}

/** Asks again until the answer is good. */
async function until(ask, isGood, within_ms) {
  const end = performance.now() + within_ms;
  for (;;) {
    const answer = await ask();
    if (isGood(answer)) return answer;
    if (performance.now() > end) throw new Error(JSON.stringify(answer));
    await new Promise((resolve) => setTimeout(resolve, 200));
  }
}

/** How many points of the plan have the colour that the file has there: around the machine, and everywhere. */
async function compare(page, address, scheme) {
  const { machines } = await (await fetch(`${address}/api/v1/fleet`)).json();
  const { pose } = machines[0];
  const picture = await look(page);
  const toPlace = (x_px, y_px) => {
    const east_m = picture.east.at_m + (x_px - picture.east.at_px) * picture.east.m_per_px;
    const north_m = picture.north.at_m + (y_px - picture.north.at_px) * picture.north.m_per_px;
    return placeNear(pose, east_m, north_m);
  };
  const count = (points) => {
    const wanted = points
      .map(([x, y]) => ({ x: Math.round(x), y: Math.round(y) }))
      .filter(({ x, y }) => x >= 0 && y >= 0 && x < picture.width && y < picture.height)
      .map(({ x, y }) => ({
        found: picture.pixel(x, y),
        zooms: expected(toPlace(x + 0.5, y + 0.5), picture),
      }))
      // Beside the edge of a block the colours mix.
      .filter(({ zooms }) => zooms !== null);
    const seen = wanted.filter(({ found, zooms }) =>
      zooms.some((colour) => near(found, mixed(colour, scheme))),
    );
    return { right: seen.length, asked: wanted.length };
  };
  const east_px = picture.east.at_px + (pose.position_m[0] - picture.east.at_m) / picture.east.m_per_px;
  const north_px = picture.north.at_px + (pose.position_m[1] - picture.north.at_m) / picture.north.m_per_px;
  const radius_px = AROUND_M / picture.east.m_per_px;
  const circle = Array.from({ length: 36 }, (_, index) => {
    const angle = (index / 36) * 2 * Math.PI;
    return [east_px + radius_px * Math.cos(angle), north_px + radius_px * Math.sin(angle)];
  });
  const raster = [];
  for (let y = 11; y < picture.height; y += 29)
    for (let x = 11; x < picture.width; x += 31) raster.push([x, y]);
  return { around: count(circle), everywhere: count(raster) };
}

/** Longitude and latitude of a place some tens of metres from the machine, whose own the site tells. */
function placeNear(pose, east_m, north_m) {
  const latitude = (pose.latitude_deg * Math.PI) / 180;
  const [a, e2] = [6_378_137, 0.006_694_379_990_14];
  const w = Math.sqrt(1 - e2 * Math.sin(latitude) ** 2);
  // The site is some 475 m above the ellipsoid.
  const along_meridian_m = (a * (1 - e2)) / w ** 3 + 475;
  const along_parallel_m = (a / w + 475) * Math.cos(latitude);
  return [
    pose.longitude_deg + ((east_m - pose.position_m[0]) / along_parallel_m) * (180 / Math.PI),
    pose.latitude_deg + ((north_m - pose.position_m[1]) / along_meridian_m) * (180 / Math.PI),
  ];
}

/** The colour of the tile that is as fine as the plan; `null` beside the edge of a block. */
function expected([longitude_deg, latitude_deg], picture) {
  const metres_per_tile_px = (z) => (40_075_017 * Math.cos((latitude_deg * Math.PI) / 180)) / 2 ** z / 256;
  const zooms = [];
  for (let zoom = 17; zoom <= ZOOM; zoom += 1) {
    const ratio = metres_per_tile_px(zoom) / picture.east.m_per_px;
    if (ratio < 0.7 || (zoom < ZOOM && ratio >= 1.42)) continue;
    const [x, y] = tileOf(longitude_deg, latitude_deg, zoom).map((value) => value * BLOCKS);
    const edge_px = (256 / BLOCKS) * Math.min(...[x, y].map((value) => Math.abs(value - Math.round(value))));
    if (edge_px * ratio < 2 + ratio) return null;
    zooms.push(colourOf(zoom, Math.floor(x), Math.floor(y)));
  }
  return zooms;
}

function mixed(colour, scheme) {
  if (scheme === "light") return colour;
  return colour.map((value, index) => SEEN_IN_THE_DARK * value + (1 - SEEN_IN_THE_DARK) * GROUND.dark[index]);
}

function near(found, wanted) {
  return wanted.every((value, index) => Math.abs(value - found[index]) <= 6);
}

/** The share of the plan that is bare ground. */
async function groundShare(page) {
  const picture = await look(page);
  let [bare, all] = [0, 0];
  for (let y = 5; y < picture.height; y += 17) {
    for (let x = 5; x < picture.width; x += 19) {
      all += 1;
      if (near(picture.pixel(x, y), GROUND.light)) bare += 1;
    }
  }
  return bare / all;
}

/** The canvas as it is, and what the labels of the grid say of its pixels. */
async function look(page) {
  const { width, height, ratio, base64, labels } = await page.evaluate(() => {
    const canvas = document.querySelector(".plan-drawing");
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    let text = "";
    for (let at = 0; at < data.length; at += 0x8000)
      text += String.fromCharCode(...data.subarray(at, at + 0x8000));
    const box = canvas.getBoundingClientRect();
    return {
      width: canvas.width,
      height: canvas.height,
      ratio: canvas.width / box.width,
      base64: btoa(text),
      labels: [...document.querySelectorAll(".grid-label")].map((label) => ({
        along: label.classList.contains("along-north") ? "east" : "north",
        text: label.textContent,
        px: Number(/\((-?[\d.]+)px/.exec(label.style.transform)[1]),
      })),
    };
  });
  if (ratio !== 1) throw new Error(`the canvas has ${ratio} pixels in a pixel`);
  const data = Buffer.from(base64, "base64");
  const scale = (along) => {
    const of = labels
      .filter((label) => label.along === along)
      .map(({ text, px }) => ({ px, m: Number(text.replace("−", "-").replaceAll(/[^\d.-]/g, "")) }))
      .sort((a, b) => a.px - b.px);
    const [first, last] = [of.at(0), of.at(-1)];
    if (of.length < 2) return { at_m: 0, at_px: 0, m_per_px: 1 };
    return { at_m: first.m, at_px: first.px, m_per_px: (last.m - first.m) / (last.px - first.px) };
  };
  return {
    width,
    height,
    east: scale("east"),
    north: scale("north"),
    pixel: (x, y) => [...data.subarray(4 * (y * width + x), 4 * (y * width + x) + 3)],
  };
}

/** `holdfast site` with a basemap, and one simulated machine that dials it. */
class SiteWithMap {
  output = "";
  #children = [];

  constructor(binary, folder) {
    this.binary = binary;
    this.folder = folder;
  }

  async start() {
    await mkdir(this.folder, { recursive: true });
    const file = join(this.folder, "site.pmtiles");
    const shipped = await readFile(new URL("site.toml", CONFIG), "utf8");
    const number = (key) => Number(new RegExp(`^${key} = ([\\d.]+)`, "m").exec(shipped)[1]);
    const metadata = {
      attribution: '<a href="https://example.org/">&copy; The makers</a> of <b>the test</b>',
    };
    const place = { longitude_deg: number("longitude_deg"), latitude_deg: number("latitude_deg") };
    await writeFile(file, makePmtiles({ ...place, zooms: [17, 18, 19, 20], reach: 9, metadata }));
    const config = shipped.replace("tcp/127.0.0.1:7447", "tcp/127.0.0.1:0");
    const map = `\n[map]\nbasemap_file = ${JSON.stringify(file)}\n`;
    await writeFile(join(this.folder, "site.toml"), `${config}${map}`);

    const data = join(this.folder, "data");
    const words = [
      "site",
      "--config",
      join(this.folder, "site.toml"),
      "--listen",
      "127.0.0.1:0",
      "--data",
      data,
    ];
    const site = this.#spawn(words);
    const said = new Promise((resolve) => {
      site.stdout.on("data", () => {
        const found = /dashboard (http:\S+?)\/\nzenoh (\S+)\n/.exec(this.output);
        if (found !== null) resolve({ address: found[1], endpoint: found[2] });
      });
    });
    const early = new Promise((_, reject) => {
      site.on("exit", (code) => reject(new Error(`the site ended (${code}):\n${this.output}`)));
    });
    early.catch(() => {});
    const { address, endpoint } = await withTimeout(
      Promise.race([said, early]),
      START_WITHIN_MS,
      () => `the site does not start:\n${this.output}`,
    );
    const scenario = fileURLToPath(new URL("scenarios/demo.toml", CONFIG));
    const record = join(this.folder, "on-board");
    const who = ["--scenario", scenario, "--machine", "walker-1", "--record", record];
    this.#spawn(["machine", ...who, "--connect", endpoint]);
    return address;
  }

  #spawn(words) {
    const child = spawn(this.binary, words, { stdio: ["ignore", "pipe", "pipe"] });
    for (const stream of [child.stdout, child.stderr]) {
      stream.on("data", (chunk) => {
        this.output += chunk;
      });
    }
    this.#children.push(child);
    return child;
  }

  /** The machine first, then the site: each with exit 0. */
  async end() {
    for (const child of [...this.#children].reverse()) {
      const ended = new Promise((resolve) => child.once("exit", (code, signal) => resolve(code ?? signal)));
      if (child.exitCode !== null || child.signalCode !== null)
        throw new Error(`it had ended:\n${this.output}`);
      child.kill("SIGTERM");
      const how = await withTimeout(ended, END_WITHIN_MS, () => `it does not end:\n${this.output}`);
      if (how !== 0) throw new Error(`it ended with ${how}:\n${this.output}`);
    }
  }

  destroy() {
    for (const child of this.#children) {
      if (child.exitCode === null && child.signalCode === null) child.kill("SIGKILL");
    }
  }
}
