/** Takes a screenshot of a running page: `node dev/screenshot.mjs URL FILE [dark] [wait_ms] [select] [WIDTHxHEIGHT]`. */

import { launch } from "../e2e/browser.mjs";

const [url, file, scheme = "light", wait_ms = "3000", select = "", size = "1440x900"] = process.argv.slice(2);
const [width, height] = size.split("x").map(Number);
const browser = await launch();
const page = await browser.newPage({
  viewport: { width, height },
  colorScheme: scheme === "dark" ? "dark" : "light",
});
page.on("console", (message) => console.log(message.type(), message.text()));
page.on("pageerror", (error) => console.log("pageerror", error.message));
await page.goto(url);
await page.waitForSelector("h1", { state: "attached" });
if (select !== "") await page.click(`.card[data-machine="${select}"] .card-head`);
await page.waitForTimeout(Number(wait_ms));
await page.screenshot({ path: file });
await browser.close();
