/** The views beside the live plan, each against what the demo really did. */

import { readdir } from "node:fs/promises";
import { join } from "node:path";

import { measureFrames } from "./pace.mjs";

/** Screenshots for the docs stand a moment, so that plots have their data. */
const SETTLE_MS = 1_500;
/** A replay of the few minutes of a demo is ready within this. */
const READ_WITHIN_MS = 30_000;

/** All of them; `ids` are the machines', `watched` is a page that is open. */
export async function views({ checks, watched, origin, ids, screenshots, nothing, noFindings }) {
  const { page } = watched;
  const go = async (name) => {
    await page.getByRole("navigation").getByRole("link", { name }).click();
    await page.getByRole("heading", { level: 1, name }).first().waitFor({ timeout: 10_000 });
  };
  const shot = async (name) => {
    await page.waitForTimeout(SETTLE_MS);
    await watched.screenshot(screenshots, name);
  };

  await checks.check("every view has an address of its own, a title, and is said", async () => {
    await go("Alerts");
    if (new URL(page.url()).pathname !== "/alerts") throw new Error(page.url());
    if (!(await page.title()).startsWith("Alerts · ")) throw new Error(await page.title());
    const said = await page.locator("[data-announcer]").innerText();
    if (said !== "Alerts") throw new Error(`the announcer says ${JSON.stringify(said)}`);
    const focused = await page.evaluate(() => document.activeElement?.id);
    if (focused !== "main") throw new Error(`the keyboard is at ${focused}`);
    await page.goBack();
    await watched.card(ids[0]).waitFor({ timeout: 10_000 });
  });

  await checks.check("the machine page has plots of the past, lanes, sensors, software", async () => {
    await page.goto(`${origin}/machines/${ids[0]}`);
    await page.locator(".plot canvas").nth(8).waitFor({ timeout: 15_000 });
    await watched.until(() => document.querySelectorAll(".lane .segment").length >= 2, undefined, 10_000);
    const text = await page.locator("main").innerText();
    for (const wanted of [/Take part now: .*Cabin IMU/, /holdfast \d+\.\d+\.\d+/, /Times in \S+/]) {
      if (!wanted.test(text)) throw new Error(`${wanted} is not in: ${text.slice(0, 600)}`);
    }
  });
  await checks.check("its configuration is asked of the machine itself", async () => {
    await page.locator(".configuration summary").click();
    const file = await page.locator(".configuration pre").innerText({ timeout: 10_000 });
    if (!file.includes(`id = "${ids[0]}"`) || !/^\[gate\]$/m.test(file)) throw new Error(file.slice(0, 400));
    await page.locator(".configuration summary").click();
  });
  await checks.check("its plots share one cursor", async () => {
    await page.locator(".plot .u-over").first().hover();
    const values = page.locator(".plot figcaption .series", { hasText: /\d/ });
    await values.nth(6).waitFor({ timeout: 5_000 });
  });
  await checks.check("a longer span reaches the plots, not the lanes alone", async () => {
    await page.getByRole("button", { name: "1 h", exact: true }).click();
    // Left in the plot is a time of which nothing is known: the nearest point is one of the last minutes.
    const over = page.locator(".plot .u-over").first();
    const box = await over.boundingBox();
    await over.hover({ position: { x: 0.1 * box.width, y: 0.5 * box.height } });
    await watched.until(
      () => {
        const plot = document.querySelector(".plot .u-over");
        // Where the nearest point has no value it is not shown, but put in its place.
        const point = plot.querySelector(".u-cursor-pt");
        const left = Number(/translate\(([-\d.]+)px/.exec(point?.style.transform)?.[1]);
        return left > 0.75 * plot.clientWidth && left <= plot.clientWidth;
      },
      undefined,
      5_000,
    );
    await page.getByRole("button", { name: "5 min", exact: true }).click();
  });
  await shot("machine");
  await checks.check("axe has no serious findings: machine", () => noFindings(watched));

  await checks.check("the outage is in the list, and in the lanes", async () => {
    await page.goto(`${origin}/outages`);
    await page.locator("[data-outage]").first().waitFor({ timeout: 15_000 });
    return (await page.locator("a.segment").count()) > 0;
  });
  await checks.check("where GNSS was missing is shown in the plan, without machines", async () => {
    await page.locator("[data-shadow-cells]:not([data-shadow-cells='0'])").waitFor({ timeout: 15_000 });
    return (await page.locator(".inset-plan .label").count()) === 0;
  });
  await checks.check("days are named by the site's zone, whatever zone times are told in", async () => {
    const from = new Date(Date.now() - 3_600_000).toISOString();
    const path = `${origin}/api/v1/outages/statistics?${new URLSearchParams({ from, to: new Date().toISOString() })}`;
    const { time_zone } = await (await fetch(path)).json();
    const utc = page.getByRole("checkbox", { name: "Times in UTC" });
    await page.locator("header .menu summary").click();
    await utc.check();
    await page.getByText(`Days in ${time_zone}`, { exact: true }).waitFor({ timeout: 5_000 });
    await utc.uncheck();
    await page.keyboard.press("Escape");
  });
  await checks.check("the print says what was filtered", async () => {
    await page.emulateMedia({ media: "print" });
    const printed = await page.locator("main").innerText();
    await page.emulateMedia({ media: "screen" });
    if (!/Period: 24 hours · Machine: all · Cause: all · At least: any/.test(printed))
      throw new Error(printed.slice(0, 400));
    return !(await page.locator("main").innerText()).includes("Period: 24 hours");
  });
  await shot("outages");
  await checks.check("axe has no serious findings: outages", () => noFindings(watched));
  await checks.check("three clicks from the outage to its moment in the recording", async () => {
    await page.locator("[data-outage] a").first().click();
    await page.locator("[data-outage-detail] .plot canvas").first().waitFor({ timeout: 10_000 });
    await shot("outage");
    const findings = await watched.seriousFindings();
    nothing(findings);
    const outage = await page.locator("[data-outage-detail]").getAttribute("data-outage-detail");
    await page.getByRole("link", { name: "Replay this moment" }).click();
    await page.locator("[data-recorded]").waitFor({ timeout: READ_WITHIN_MS });
    const { pathname } = new URL(page.url());
    if (!pathname.startsWith("/sessions/")) throw new Error(page.url());
    const ask = async (path) => (await fetch(`${origin}/api/v1${path}`)).json();
    const { start } = await ask(`/outages/${outage}`);
    const recording = await ask(`${pathname}/track`);
    const began_s = (Date.parse(start) - Date.parse(recording.start)) / 1000;
    const shown_s = Number(await page.locator(".scrubber").inputValue());
    if (began_s < 5) throw new Error(`the outage began ${began_s} s into the recording: nothing can be told`);
    if (Math.abs(shown_s - began_s) > 0.2) throw new Error(`it began at ${began_s} s, shown is ${shown_s} s`);
  });

  await checks.check("plots that stand still mark the moment, too", async () => {
    await page.locator(".replay-plots .plot canvas").nth(3).waitFor({ timeout: 10_000 });
    await page.waitForTimeout(SETTLE_MS);
    const { share, marked } = await page.evaluate(() => {
      const scrubber = document.querySelector(".scrubber");
      const over = document.querySelector(".replay-plots .u-over").getBoundingClientRect();
      const mark = document.querySelector(".replay-plots .plot-now").getBoundingClientRect();
      return { share: scrubber.value / scrubber.max, marked: (mark.left - over.left) / over.width };
    });
    if (share < 0.05 || Math.abs(share - marked) > 0.02) throw new Error(`${marked} instead of ${share}`);
  });

  await checks.check("the recording is in the list, with its machines, to replay", async () => {
    await page.goto(`${origin}/sessions`);
    const session = page.locator(".session").first();
    await session.waitFor({ timeout: 15_000 });
    const link = session.getByRole("link", { name: /MCAP/ });
    const response = await page.request.get(new URL(await link.getAttribute("href"), origin).href);
    const start = (await response.body()).subarray(0, 5).toString("latin1");
    if (!response.ok() || start !== "\x89MCAP")
      throw new Error(`${response.status()} ${JSON.stringify(start)}`);
  });
  await checks.check("name, notes and tags are written, and found again", async () => {
    const session = page.locator(".session").first();
    await session.getByRole("button", { name: "Notes …" }).click();
    await session.getByLabel("Name").fill("Trench 4");
    await session.getByLabel("Notes").fill("Ditch along the row of poplars");
    await session.getByLabel("Tags").fill("trench, trees");
    // What was typed stays while the machines go on and the rest of the page is drawn anew.
    await page.waitForTimeout(2_000);
    await session.getByRole("button", { name: "Save" }).click();
    await page.locator(".tags li", { hasText: "trees" }).waitFor({ timeout: 5_000 });
    const found = async (words) => {
      await page.getByLabel("Search").fill(words);
      // Drawn with the next frame.
      await page.waitForTimeout(200);
      return page.locator(".session").count();
    };
    for (const words of ["Trench 4", "poplars", "trees"]) {
      if ((await found(words)) !== 1) throw new Error(`not found by ${words}`);
    }
    if ((await found("no such words")) !== 0) throw new Error("the search finds what is not there");
    await page.getByText("No recording has these words.").waitFor({ timeout: 2_000 });
    return (await found("trench")) === 1;
  });
  await shot("recordings");
  await checks.check("axe has no serious findings: recordings", () => noFindings(watched));

  await replay({ checks, watched, ids, shot, noFindings });

  await checks.check("the alerts view is there, quiet unless asked", async () => {
    await page.goto(`${origin}/alerts`);
    await page.getByRole("heading", { level: 1, name: "Alerts" }).waitFor({ timeout: 10_000 });
    return !(await page.getByRole("checkbox", { name: "Sound for new alerts" }).last().isChecked());
  });
  await checks.check("what is open is known also where no WebSocket gets through", async () => {
    const context = await page.context().browser().newContext({ locale: "en-GB" });
    const deaf = await context.newPage();
    await deaf.routeWebSocket(/\/api\/v1\/live/, (socket) => socket.close());
    await deaf.goto(`${origin}/alerts`);
    const ids = (list) =>
      list
        .map(({ id }) => id)
        .sort()
        .join();
    const asked = ["active", "acknowledged", "cleared_unacknowledged"].map(async (state) => {
      const answer = await fetch(`${origin}/api/v1/alerts?state=${state}`);
      return (await answer.json()).alerts;
    });
    const open = (await Promise.all(asked)).flat();
    if (open.length === 0) throw new Error("the demo's outage has raised none");
    await deaf.waitForFunction(
      (wanted) =>
        [...document.querySelectorAll("section[aria-labelledby=open-alerts] [data-alert]")]
          .map((alert) => alert.dataset.alert)
          .sort()
          .join() === wanted,
      ids(open),
      { timeout: 10_000 },
    );
    await context.close();
  });
  await checks.check("an alert is acknowledged with a note, and says who saw it", async () => {
    // The demo's outage has raised one.
    const alert = page.locator(".alert", { has: page.getByRole("button", { name: "Acknowledge" }) }).first();
    await alert.getByRole("button", { name: "Acknowledge" }).click();
    const id = await page.locator(".alert:has(form)").getAttribute("data-alert");
    await page.getByLabel("Note").fill("Trees along trench 4");
    await page.keyboard.press("Enter");
    await page
      .locator(`.alert[data-alert="${id}"]`, { hasText: /Seen by .+: “Trees along trench 4”/ })
      .waitFor({ timeout: 10_000 });
  });
  await shot("alerts");
  await checks.check("axe has no serious findings: alerts", () => noFindings(watched));

  await checks.check("a path that is no view is not found, an old link to one works", async () => {
    const status = async (path) => (await fetch(`${origin}${path}`)).status;
    const found = [
      await status("/outages/some-id"),
      await status("/nowhere"),
      await status("/machines/a.js"),
    ];
    if (found.join() !== "200,404,404") throw new Error(found.join());
  });

  await page.goto(origin);
  await watched.card(ids[0]).waitFor({ timeout: 10_000 });
}

async function replay({ checks, watched, ids, shot, noFindings }) {
  const { page } = watched;
  const now_s = async () => Number(await page.locator(".scrubber").inputValue());
  await checks.check("a recording is replayed: all machines, on the plan and in plots", async () => {
    await page.locator(".session").first().getByRole("link", { name: "Replay" }).click();
    await page.locator("[data-recorded]").waitFor({ timeout: READ_WITHIN_MS });
    await page.getByText("RECORDED").waitFor();
    if ((await page.locator(".card[data-machine]").count()) !== ids.length)
      throw new Error("machines are missing");
    await page.locator(".replay-plots .plot canvas").nth(3).waitFor({ timeout: 10_000 });
  });
  await checks.check("it jumps to events, and shows the machine as it was then", async () => {
    await page.keyboard.press("Home");
    const words = [];
    for (let step = 0; step < 12; step += 1) {
      await page.getByRole("button", { name: "Next event" }).click();
      await page.keyboard.press("ArrowRight");
      await page.waitForTimeout(250);
      words.push(...(await page.locator(".card .state-word").allInnerTexts()));
      if (words.some((word) => word.startsWith("HOLDING"))) return true;
    }
    throw new Error(`no HOLDING among: ${[...new Set(words)].join(" | ")}`);
  });
  await shot("replay");
  await checks.check("it plays at the speed that was chosen, by the keyboard alone", async () => {
    await page.keyboard.press("Home");
    await page.locator("#main").focus();
    for (let step = 0; step < 3; step += 1) await page.keyboard.press("]");
    const before = await now_s();
    const start = performance.now();
    await page.keyboard.press(" ");
    await page.waitForTimeout(3_000);
    await page.keyboard.press(" ");
    const passed_s = (performance.now() - start) / 1000;
    const speed = ((await now_s()) - before) / passed_s;
    // Drawing may be late, but it does not run ahead.
    if (speed < 5 || speed > 8.5) throw new Error(`it went ${speed.toFixed(1)} times as fast as life`);
  });
  await checks.check("while it plays, at least 20 frames a second are drawn", async () => {
    await page.keyboard.press("Home");
    await page.keyboard.press(" ");
    const { fps } = await measureFrames(page, 3);
    await page.keyboard.press(" ");
    if (fps < 20) throw new Error(`${fps} frames a second`);
  });
  await checks.check("axe has no serious findings: replay", () => noFindings(watched));
}

/** What the recordings' folder holds. */
export async function recordedFiles(data) {
  const sessions = join(data, "sessions");
  return (await readdir(sessions, { recursive: true })).filter((file) => file.endsWith(".mcap"));
}
