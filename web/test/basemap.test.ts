import { afterEach, beforeEach, describe, expect, it, vi } from "vitest";

import { attributionOf, plainText } from "../src/basemap/attribution";
import {
  type Coverage,
  fromTiles,
  placementOf,
  TILES_SEEN_MAX,
  type Tile,
  tileName,
  tilesSeen,
  toTiles,
  zoomFor,
} from "../src/basemap/mercator";
import { BadTile, LOADING_MAX, RETRY_MS, TileStore } from "../src/basemap/tile-store";
import { type Metres, SiteFrame } from "../src/geometry/geodesy";

const frame = new SiteFrame({ latitude_deg: 47.4801402, longitude_deg: 8.49975325, altitude_m: 474.9 });
const WORLD: Coverage = { minZoom: 0, maxZoom: 22, west: -180, south: -90, east: 180, north: 90 };

/** The tile under a place of the site. */
function tileAt(at: Metres, z: number): Tile {
  const [x, y] = toTiles(frame.toLngLat(at), z);
  return { z, x: Math.floor(x), y: Math.floor(y) };
}

/** How far the affine map is from where points of the tile are, m: at the corners, and anywhere. */
function errors(tile: Tile): { corner_m: number; worst_m: number } {
  const { corner, right, down } = placementOf(tile, frame);
  const error = (u: number, v: number) => {
    const [east, north] = frame.toMetres(fromTiles([tile.x + u, tile.y + v], tile.z));
    const mapped = [corner[0] + u * right[0] + v * down[0], corner[1] + u * right[1] + v * down[1]] as const;
    return Math.hypot(mapped[0] - east, mapped[1] - north);
  };
  const steps = [0, 0.25, 0.5, 0.75, 1];
  return {
    corner_m: Math.max(error(0, 0), error(1, 0), error(0, 1), error(1, 1)),
    worst_m: Math.max(...steps.flatMap((u) => steps.map((v) => error(u, v)))),
  };
}

describe("tiles on the site's metres", () => {
  it("are numbered as everybody numbers them", () => {
    // The corners of the world, and a place by the formula with logarithm, tangent and secant.
    expect(toTiles([0, 0], 1)).toEqual([1, 1]);
    expect(toTiles([-180, 85.0511287798], 0)[1]).toBeCloseTo(0, 9);
    const [x, y] = toTiles([8.49975325, 47.4801402], 16).map(Math.floor);
    expect([x, y]).toEqual([34315, 22921]);
    const [longitude, latitude] = fromTiles(toTiles([8.5, 47.48], 20), 20);
    expect(longitude).toBeCloseTo(8.5, 11);
    expect(latitude).toBeCloseTo(47.48, 11);
  });

  it("lie within a centimetre of their outlines from zoom 16 on, also at the site's edge", () => {
    for (const at of [
      [0, 0],
      [500, 500],
      [-1000, 1000],
    ] as const) {
      const { corner_m, worst_m } = errors(tileAt(at, 16));
      expect(corner_m).toBeLessThan(0.01);
      expect(worst_m).toBeLessThan(0.01);
      // 7.3 mm at zoom 16, whose pixels are 1.6 m; it gets better by four with each zoom.
      expect(errors(tileAt(at, 17)).worst_m).toBeLessThan(0.0025);
      expect(errors(tileAt(at, 20)).worst_m).toBeLessThan(0.0001);
    }
  });

  it("stay below a pixel of theirs also where the plan is at its smallest", () => {
    const tile = tileAt([0, 0], 11);
    const { right } = placementOf(tile, frame);
    expect(errors(tile).worst_m / (Math.hypot(right[0], right[1]) / 256)).toBeLessThan(0.2);
  });

  it("meet their neighbours", () => {
    const one = tileAt([0, 0], 18);
    const a = placementOf(one, frame);
    const b = placementOf({ ...one, x: one.x + 1 }, frame);
    expect(
      Math.hypot(a.corner[0] + a.right[0] - b.corner[0], a.corner[1] + a.right[1] - b.corner[1]),
    ).toBeLessThan(0.001);
  });
});

describe("which tiles are seen", () => {
  const extent = { min: [-30, -20], max: [30, 20] } as const;

  it("by the zoom that is as fine as the plan", () => {
    // At zoom 20 a pixel is 0.1009 m there.
    expect(zoomFor(0.1009, 256, 47.48)).toBe(20);
    expect(zoomFor(0.1009, 512, 47.48)).toBe(19);
    expect(zoomFor(0.2, 256, 47.48)).toBe(19);
    const seen = tilesSeen(extent, 0.1, 256, frame, WORLD);
    expect(new Set(seen.map(({ z }) => z))).toEqual(new Set([20]));
  });

  it("all that reach into view, those in the middle first, and no others", () => {
    const seen = tilesSeen(extent, 0.1, 256, frame, WORLD);
    const names = new Set(seen.map(tileName));
    expect(names.size).toBe(seen.length);
    for (const at of [
      [-30, -20],
      [30, 20],
      [-30, 20],
      [30, -20],
      [0, 0],
    ] as const) {
      expect(names).toContain(tileName(tileAt(at, 20)));
    }
    expect(names).not.toContain(tileName(tileAt([60, 0], 20)));
    const first = seen[0] as Tile;
    const { corner, right, down } = placementOf(first, frame);
    const middle = Math.hypot(corner[0] + (right[0] + down[0]) / 2, corner[1] + (right[1] + down[1]) / 2);
    expect(middle).toBeLessThan(20);
  });

  it("no finer ones than the archive has, and none beyond its bounds", () => {
    expect(tilesSeen(extent, 0.01, 256, frame, { ...WORLD, maxZoom: 18 }).every(({ z }) => z === 18)).toBe(
      true,
    );
    const [west, north] = frame.toLngLat([-5, 5]);
    const [east, south] = frame.toLngLat([5, -5]);
    const small = tilesSeen(extent, 0.1, 256, frame, { ...WORLD, west, north, east, south });
    expect(small.length).toBeGreaterThan(0);
    expect(small.length).toBeLessThanOrEqual(4);
    expect(tilesSeen(extent, 0.1, 256, frame, { ...WORLD, west: 9, east: 10 })).toEqual([]);
  });

  it("coarser ones on a very large screen, none where the archive has only fine ones", () => {
    const wide = { min: [-600, -400], max: [600, 400] } as const;
    const seen = tilesSeen(wide, 0.1, 256, frame, WORLD);
    expect(seen.length).toBeLessThanOrEqual(TILES_SEEN_MAX);
    expect(seen.length).toBeGreaterThan(TILES_SEEN_MAX / 8);
    expect(tilesSeen(wide, 1, 256, frame, { ...WORLD, minZoom: 21 })).toEqual([]);
  });
});

interface Made {
  tile: string;
  width: number;
  height: number;
  closed: boolean;
  close(): void;
}

function picture({ z, x, y }: Tile, side = 256): Made {
  const made: Made = {
    tile: `${z}/${x}/${y}`,
    width: side,
    height: side,
    closed: false,
    close() {
      made.closed = true;
    },
  };
  return made;
}

const row = (count: number, y = 0): Tile[] => Array.from({ length: count }, (_, x) => ({ z: 20, x, y }));

describe("tiles that are kept", () => {
  beforeEach(() => {
    vi.useFakeTimers();
  });
  afterEach(() => {
    vi.useRealTimers();
  });

  it("are asked for a few at a time, in the order they are wanted, and each once", async () => {
    const asked: string[] = [];
    const answers: (() => void)[] = [];
    const store = new TileStore<Made>((tile) => {
      asked.push(tileName(tile));
      return new Promise((resolve) => answers.push(() => resolve(picture(tile))));
    });
    const tiles = row(10);
    store.want(tiles);
    store.want(tiles);
    expect(asked).toEqual(tiles.slice(0, LOADING_MAX).map(tileName));
    answers.shift()?.();
    await vi.advanceTimersByTimeAsync(0);
    expect(asked).toHaveLength(LOADING_MAX + 1);
    expect(store.get(tiles[0] as Tile)?.tile).toBe("20/0/0");
    expect(store.get(tiles[9] as Tile)).toBeNull();
  });

  it("are not asked for any more when nobody looks", async () => {
    const asked: string[] = [];
    const answers: (() => void)[] = [];
    const store = new TileStore<Made>((tile) => {
      asked.push(tileName(tile));
      return new Promise((resolve) => answers.push(() => resolve(picture(tile))));
    });
    store.want(row(10));
    store.want([]);
    for (const answer of answers) answer();
    await vi.advanceTimersByTimeAsync(60_000);
    expect(asked).toHaveLength(LOADING_MAX);
  });

  it("are let go when there are too many: those that were not used for longest, and none that is seen", async () => {
    const made = new Map<string, Made>();
    const store = new TileStore<Made>(
      async (tile) => {
        const it = picture(tile);
        made.set(it.tile, it);
        return it;
      },
      8 * 256 * 256,
    );
    const seen = row(6);
    store.want(seen);
    await vi.advanceTimersByTimeAsync(0);
    store.want(row(2, 1));
    await vi.advanceTimersByTimeAsync(0);
    // Used again: the second is the oldest now.
    store.get(seen[0] as Tile);
    store.want(row(4, 1));
    await vi.advanceTimersByTimeAsync(0);
    const gone = [...made.values()].filter(({ closed }) => closed).map(({ tile }) => tile);
    expect(gone).toEqual(["20/1/0", "20/2/0"]);
    expect(store.get(seen[1] as Tile)).toBeNull();
    expect(store.get(seen[0] as Tile)?.tile).toBe("20/0/0");
    // More in sight than there is room for: all of them stay.
    store.want(row(12, 2));
    await vi.advanceTimersByTimeAsync(0);
    expect(row(12, 2).every((tile) => store.get(tile) !== null)).toBe(true);
  });

  it("that are not there are asked for once", async () => {
    const load = vi.fn(async () => null);
    const store = new TileStore<Made>(load);
    store.want(row(2));
    await vi.advanceTimersByTimeAsync(0);
    store.want(row(2));
    await vi.advanceTimersByTimeAsync(60_000);
    expect(load).toHaveBeenCalledTimes(2);
    expect(store.failure.value).toBeNull();
  });

  it("are waited for when the site does not answer: told once, asked again later, and well then", async () => {
    let works = false;
    const load = vi.fn(async (tile: Tile) => {
      if (!works) throw new Error("no answer");
      return picture(tile);
    });
    const store = new TileStore<Made>(load);
    const told: unknown[] = [];
    store.failure.subscribe((failure) => told.push(failure));
    store.want(row(10));
    await vi.advanceTimersByTimeAsync(RETRY_MS - 1);
    store.want(row(10));
    expect(load).toHaveBeenCalledTimes(LOADING_MAX);
    await vi.advanceTimersByTimeAsync(1);
    expect(load).toHaveBeenCalledTimes(2 * LOADING_MAX);
    expect(told).toHaveLength(2);
    works = true;
    await vi.advanceTimersByTimeAsync(RETRY_MS);
    expect(told).toHaveLength(3);
    expect(store.failure.value).toBeNull();
    expect(row(10).every((tile) => store.get(tile) !== null)).toBe(true);
  });

  it("that are no pictures are passed over, and the others come", async () => {
    const load = vi.fn(async (tile: Tile) => {
      if (tile.x === 0) throw new BadTile("not a picture");
      return picture(tile);
    });
    const store = new TileStore<Made>(load);
    store.want(row(9));
    await vi.advanceTimersByTimeAsync(RETRY_MS);
    store.want(row(9));
    await vi.advanceTimersByTimeAsync(RETRY_MS);
    expect(load).toHaveBeenCalledTimes(9);
    expect(store.failure.value).toBeInstanceOf(BadTile);
    expect(store.get({ z: 20, x: 8, y: 0 })).not.toBeNull();
    expect(store.side_px).toBe(256);
  });
});

describe("who is to be named", () => {
  it("is plain text, whatever the archive says", () => {
    const said = '<a href="https://example.org/copyright" target="_blank">&copy; The Makers</a> &amp; &#67;o';
    expect(attributionOf({ attribution: said })).toBe("© The Makers & Co");
    expect(plainText("<script>alert(1)</script><b>A</b>\n B &#x2014; &unknown;")).toBe("A B — &unknown;");
    expect(plainText("&lt;b&gt;")).toBe("<b>");
  });

  it("is nobody where it is not said", () => {
    expect([attributionOf({}), attributionOf(null), attributionOf({ attribution: 7 })]).toEqual(["", "", ""]);
    expect(attributionOf({ attribution: "x".repeat(400) })).toHaveLength(300);
  });
});
