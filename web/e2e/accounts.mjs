/** Who may do what, as people see it: signing in and out, roles, tokens, accounts. Ends with accounts on the site. */

import { spawnSync } from "node:child_process";

import { Watched } from "./page.mjs";

/** The account that the site has in the end. */
export const ADMIN = { name: "anna", password: "a long password 1" };
const SECOND = { name: "berta", password: "a long password 3" };
const VIEWER = { name: "victor", password: "a long password 2" };

export async function signInAs(page, { name, password }) {
  await page.getByLabel("Name").fill(name);
  await page.getByLabel("Password").fill(password);
  await page.getByRole("button", { name: "Sign in" }).click();
}

export async function accounts({ checks, browser, origin, binary, data, screenshots, noFindings }) {
  await checks.check("the first account is made on the command line, while the site runs", () => {
    const words = ["site", "user", "add", ADMIN.name, "--role", "admin", "--password-stdin", "--data", data];
    const { status, stderr } = spawnSync(binary, words, { input: ADMIN.password, encoding: "utf8" });
    if (status !== 0) throw new Error(stderr);
  });
  const watched = await Watched.open(browser, origin, { path: "/alerts" });
  const { page } = watched;
  const signIn = (account) => signInAs(page, account);
  const menu = () => page.locator("header .menu summary");

  await checks.check("who is not signed in sees nothing but the door", async () => {
    await page.getByRole("heading", { name: "Sign in" }).waitFor({ timeout: 10_000 });
    return (await page.getByRole("navigation").count()) === 0;
  });
  await checks.check("axe has no serious findings: sign-in", () => noFindings(watched));
  await watched.screenshot(screenshots, "sign-in");
  await checks.check("a wrong password is told, and lets nobody in", async () => {
    await signIn({ ...ADMIN, password: "not this one" });
    await page.getByText("Name or password is wrong.").waitFor({ timeout: 10_000 });
  });
  await checks.check("the right one leads to where one wanted to go", async () => {
    await signIn(ADMIN);
    await page.getByRole("heading", { level: 1, name: "Alerts" }).waitFor({ timeout: 10_000 });
    if (new URL(page.url()).pathname !== "/alerts") throw new Error(page.url());
    await watched.until(() => document.querySelector('[data-link="open"]') !== null, undefined, 10_000);
  });
  const toAccount = async () => {
    await menu().click();
    await page.getByRole("link", { name: "Account", exact: true }).click();
  };
  await checks.check(
    "an admin makes an account for somebody who may only look, and for another admin",
    async () => {
      await toAccount();
      const form = page
        .locator("section", { has: page.getByRole("heading", { name: "Accounts" }) })
        .locator("form");
      for (const [{ name, password }, role] of [
        [VIEWER, "viewer"],
        [SECOND, "admin"],
      ]) {
        await form.getByLabel("Name").fill(name);
        await form.getByLabel("Role").selectOption(role);
        await form.getByLabel(/New password/).fill(password);
        await form.getByRole("button", { name: "Add account" }).click();
        await page.getByRole("rowheader", { name }).waitFor({ timeout: 10_000 });
      }
    },
  );
  await checks.check("a token for a program is shown once, works, and is revoked", async () => {
    await page.getByLabel("What for").fill("export at night");
    await page.getByRole("button", { name: "Make a token" }).click();
    const secret = await page.locator(".secret code").innerText({ timeout: 10_000 });
    const ask = async () =>
      (await fetch(`${origin}/api/v1/fleet`, { headers: { authorization: `Bearer ${secret}` } })).status;
    if ((await ask()) !== 200) throw new Error("it does not work");
    await page.getByRole("button", { name: "Revoke token export at night" }).click();
    await page
      .getByRole("cell", { name: "export at night", exact: true })
      .waitFor({ state: "detached", timeout: 10_000 });
    if ((await page.locator(".secret").count()) > 0) throw new Error("it is still there to copy");
    return (await ask()) === 401;
  });
  await checks.check("axe has no serious findings: account", () => noFindings(watched));
  await watched.screenshot(screenshots, "account");
  const signOut = async () => {
    await menu().click();
    await page.getByRole("button", { name: "Sign out" }).click();
    await page.getByRole("heading", { name: "Sign in" }).waitFor({ timeout: 10_000 });
  };
  await checks.check("signing out closes the door behind one", async () => {
    await signOut();
    return (await page.request.get(`${origin}/api/v1/fleet`)).status() === 401;
  });
  await checks.check(
    "an admin who takes the role from herself is offered nothing of it any more",
    async () => {
      await signIn(SECOND);
      await page.locator("header").waitFor({ timeout: 10_000 });
      await toAccount();
      const users = page.getByRole("heading", { name: "Accounts" });
      await users.waitFor({ timeout: 10_000 });
      await page.getByLabel(`Role of ${SECOND.name}`).selectOption("viewer");
      await users.waitFor({ state: "detached", timeout: 10_000 });
      await page
        .locator("main")
        .getByText(`Signed in as ${SECOND.name} (viewer)`)
        .waitFor({ timeout: 5_000 });
      await signOut();
    },
  );
  await checks.check("who may only look is offered nothing else", async () => {
    await signIn(VIEWER);
    await page.locator("header").waitFor({ timeout: 10_000 });
    await page.getByRole("navigation").getByRole("link", { name: "Recordings" }).click();
    await page.locator(".session").first().waitFor({ timeout: 10_000 });
    const offered = await page.getByRole("button", { name: /Notes|recording/ }).count();
    if (offered > 0) throw new Error(`${offered} buttons of operators`);
    await page.getByRole("navigation").getByRole("link", { name: "Live" }).click();
    await page.locator(".plan canvas").waitFor({ timeout: 10_000 });
    return (await page.getByText("Plan …").count()) === 0;
  });
  await watched.close();
}
