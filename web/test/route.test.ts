import { describe, expect, it, vi } from "vitest";

// The room reads the address when it is loaded, as it does in a browser.
vi.stubGlobal("window", { location: { pathname: "/", search: "?lang=de&plan=old" } });
const { parseRoute, paths } = await import("../src/route");

describe("the address", () => {
  it("names a view, and what it is of", () => {
    expect(parseRoute("/", "")).toMatchObject({ view: "live", id: null });
    expect(parseRoute("/machines/menzi-1", "")).toMatchObject({ view: "machine", id: "menzi-1" });
    expect(parseRoute("/outages", "?machine=a")?.query.get("machine")).toBe("a");
    expect(parseRoute("/outages/o-7", "")).toMatchObject({ view: "outage", id: "o-7" });
    expect(parseRoute("/sessions/20261123T050000Z", "?t=12")).toMatchObject({ view: "replay" });
    expect(parseRoute("/alerts/", "")).toMatchObject({ view: "alerts" });
  });

  it("names nothing else", () => {
    for (const path of ["/machines", "/nowhere", "/outages/a/b", "/account/x", "/sign-in/x"]) {
      expect(parseRoute(path, ""), path).toBeNull();
    }
  });

  it("keeps what a person chose, and writes ids so that they are read back", () => {
    expect(paths.live()).toBe("/?lang=de");
    const url = new URL(paths.replay("a b", "2026-11-23T05:00:00Z", "m"), "http://site");
    expect(parseRoute(url.pathname, url.search)).toMatchObject({ view: "replay", id: "a b" });
    expect(url.searchParams.get("at")).toBe("2026-11-23T05:00:00Z");
    expect(url.searchParams.get("lang")).toBe("de");
  });
});
