/** The page as a test sees it: what it asks for, what it complains about, what it shows. */

import { readFile } from "node:fs/promises";
import { createRequire } from "node:module";
import { join } from "node:path";

const require = createRequire(import.meta.url);

/** A site without a plan of its own has no such path: the page asks, and goes on without. */
const OPTIONAL = "/api/v1/plan";

export class Watched {
  /** Requests to anywhere but the page's own origin. */
  foreign = [];
  /** Errors on the console, uncaught ones, and violations of the content security policy. */
  complaints = [];

  constructor(page, origin) {
    this.page = page;
    this.origin = origin;
    const seen = (url) => {
      const own = url.startsWith(origin) || url.startsWith(origin.replace("http", "ws"));
      if (!own && !/^(data|blob|about):/.test(url)) this.foreign.push(url);
    };
    page.on("request", (request) => seen(request.url()));
    page.on("websocket", (socket) => seen(socket.url()));
    page.on("worker", (worker) => seen(worker.url()));
    page.on("console", (message) => {
      const notThere = new URL(message.location().url || origin).pathname === OPTIONAL;
      if (message.type() === "error" && !notThere) this.complaints.push(message.text());
    });
    page.on("pageerror", (error) => this.complaints.push(error.message));
    page.on("requestfailed", (request) => {
      const reason = request.failure()?.errorText;
      // Chromium says "aborted" only of what the page itself let go: its probe of the link after two seconds, and
      // what was on its way when a view was left. What a server breaks off has other names.
      const letGo = reason === "net::ERR_ABORTED";
      if (!letGo) this.complaints.push(`${request.url()}: ${reason}`);
    });
  }

  static async open(browser, origin, { colorScheme = "light", path = "/", width = 1440, height = 900 } = {}) {
    const context = await browser.newContext({ viewport: { width, height }, colorScheme, locale: "en-GB" });
    const page = await context.newPage();
    const watched = new Watched(page, origin);
    await page.addInitScript(() => {
      document.addEventListener("securitypolicyviolation", (event) => {
        console.error(`content security policy: ${event.violatedDirective} ${event.blockedURI}`);
      });
    });
    await page.goto(`${origin}${path}`);
    return watched;
  }

  /** Leaves the browser to the others. */
  close() {
    return this.page.context().close();
  }

  card(id) {
    return this.page.locator(`.card[data-machine="${id}"]`);
  }

  async cardIds() {
    return this.page
      .locator(".card[data-machine]")
      .evaluateAll((cards) => cards.map((card) => card.dataset.machine));
  }

  async labelIds() {
    return this.page
      .locator(".label[data-machine]")
      .evaluateAll((labels) => labels.map((label) => label.dataset.machine));
  }

  stateWord(id) {
    return this.card(id).locator(".state-word").innerText();
  }

  /** Resolves once `test`, run in the page, comes to something true. */
  until(test, argument, within_ms) {
    return this.page.waitForFunction(test, argument, { timeout: within_ms, polling: 50 });
  }

  /** What axe finds serious or critical. */
  async seriousFindings() {
    const source = await readFile(require.resolve("axe-core/axe.min.js"), "utf8");
    // By the debugger's door, which the page's policy does not close.
    await this.page.evaluate(source);
    const { violations } = await this.page.evaluate(() =>
      window.axe.run(document, { resultTypes: ["violations"] }),
    );
    return violations
      .filter(({ impact }) => impact === "serious" || impact === "critical")
      .map(
        ({ id, help, nodes }) =>
          `${id}: ${help}: ${nodes.map((node) => node.html.slice(0, 120)).join(" | ")}`,
      );
  }

  async screenshot(folder, name) {
    if (folder !== undefined) await this.page.screenshot({ path: join(folder, `${name}.png`) });
  }
}
