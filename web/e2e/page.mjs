/** The page as a test sees it: what it asks for, what it complains about, what it shows. */

import { readFile } from "node:fs/promises";
import { createRequire } from "node:module";
import { join } from "node:path";

const require = createRequire(import.meta.url);

/** A site without a plan of its own has no such path: the page asks, and goes on without. */
const OPTIONAL = "/api/v1/plan";
/** The page gives its own probe of the link two seconds, and then lets it go. */
const PROBE = "/healthz";
/** What a view had asked for is let go this close to the moment at which it is left. */
const LEAVING_MS = 1_000;

export class Watched {
  /** Requests to anywhere but the page's own origin. */
  foreign = [];
  #complaints = [];
  /** Questions that were let go, and when. */
  #letGo = [];
  /** When the page went to another view, or wrote into its address what it shows. */
  #left_ms = [];
  #closed = false;
  #answers = [];

  /** Errors on the console, uncaught ones, violations of the content security policy, and requests that failed. */
  get complaints() {
    const unasked = this.#letGo.filter(
      ({ at_ms }) => !this.#left_ms.some((left_ms) => Math.abs(left_ms - at_ms) <= LEAVING_MS),
    );
    return [...this.#complaints, ...unasked.map(({ url }) => `${url}: let go, but the page was not left`)];
  }

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
      if (message.type() === "error" && !notThere) this.#complaints.push(message.text());
    });
    page.on("pageerror", (error) => this.#complaints.push(error.message));
    page.on("response", (response) => this.#answers.push(response));
    page.on("requestfailed", (request) => {
      const reason = request.failure()?.errorText;
      const url = request.url();
      // Chromium says "aborted" only of what the page itself let go; what a server breaks off has other names.
      if (reason !== "net::ERR_ABORTED" || request.method() !== "GET") {
        this.#complaints.push(`${request.method()} ${url}: ${reason}`);
      } else if (!this.#closed && new URL(url).pathname !== PROBE) {
        this.#letGo.push({ url, at_ms: performance.now() });
      }
    });
    page.on("framenavigated", (frame) => {
      if (frame === page.mainFrame()) this.#left_ms.push(performance.now());
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

  /** The answer to a question of the page, asked before or soon, by its address. */
  async answered(isWanted, within_ms = 10_000) {
    const known = this.#answers.find((response) => isWanted(response.url()));
    return known ?? this.page.waitForResponse((response) => isWanted(response.url()), { timeout: within_ms });
  }

  /** Leaves the browser to the others. */
  close() {
    this.#closed = true;
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
