/**
 * Web Mercator tiles (z, x, y; y from the north) on the site's metres: which of them are seen, and where they lie.
 *
 * A tile is put down by an affine map. Against its true outline that is off by millimetres at zoom 16, and by a
 * quarter of that with each zoom more.
 */

import type { LngLat, Metres, SiteFrame } from "../geometry/geodesy";
import type { Extent } from "../geometry/grid";

export interface Tile {
  z: number;
  x: number;
  y: number;
}

/** What an archive holds: its zooms, and the part of the world in degrees. */
export interface Coverage {
  minZoom: number;
  maxZoom: number;
  west: number;
  south: number;
  east: number;
  north: number;
}

/** Where a tile's upper left corner lies, and where its upper and its left edge lead from there. */
export interface Placement {
  corner: Metres;
  right: Metres;
  down: Metres;
}

/** With more tiles than this in sight, a coarser zoom will do. */
export const TILES_SEEN_MAX = 96;

const EQUATOR_M = 2 * Math.PI * 6_378_137;
const DEGREE = Math.PI / 180;
/** Web Mercator ends here. */
const LATITUDE_MAX_DEG = 85.051_128_779_806_59;

export function tileName({ z, x, y }: Tile): string {
  return `${z}/${x}/${y}`;
}

/** Tiles of a zoom, whole and in part, from the world's north-west corner. */
export function toTiles([longitude, latitude]: LngLat, z: number): [number, number] {
  const bounded = Math.max(-LATITUDE_MAX_DEG, Math.min(LATITUDE_MAX_DEG, latitude)) * DEGREE;
  const side = 2 ** z;
  return [((longitude + 180) / 360) * side, ((1 - Math.asinh(Math.tan(bounded)) / Math.PI) / 2) * side];
}

export function fromTiles([x, y]: readonly [number, number], z: number): LngLat {
  const side = 2 ** z;
  return [(x / side) * 360 - 180, Math.atan(Math.sinh(Math.PI * (1 - (2 * y) / side))) / DEGREE];
}

/** The affine map that is nearest to all four corners. */
export function placementOf({ z, x, y }: Tile, frame: SiteFrame): Placement {
  const at = (right: number, down: number) => frame.toMetres(fromTiles([x + right, y + down], z));
  const [nw, ne, sw, se] = [at(0, 0), at(1, 0), at(0, 1), at(1, 1)];
  const per = (of: (axis: 0 | 1) => number): Metres => [of(0), of(1)];
  const right = per((axis) => (ne[axis] - nw[axis] + se[axis] - sw[axis]) / 2);
  const down = per((axis) => (sw[axis] - nw[axis] + se[axis] - ne[axis]) / 2);
  const middle = per((axis) => (nw[axis] + ne[axis] + sw[axis] + se[axis]) / 4);
  return { corner: per((axis) => middle[axis] - (right[axis] + down[axis]) / 2), right, down };
}

/** The zoom whose tile pixels are nearest to those of the plan. */
export function zoomFor(metresPerPixel: number, tile_px: number, latitude_deg: number): number {
  const world_px = (EQUATOR_M * Math.cos(latitude_deg * DEGREE)) / metresPerPixel;
  return Math.round(Math.log2(world_px / tile_px));
}

interface Block {
  x0: number;
  x1: number;
  y0: number;
  y1: number;
}

/** The tiles that show a part of the plan, from its middle outwards; none where there is nothing, or far too much. */
export function tilesSeen(
  extent: Extent,
  metresPerPixel: number,
  tile_px: number,
  frame: SiteFrame,
  coverage: Coverage,
): Tile[] {
  const wanted = zoomFor(metresPerPixel, tile_px, frame.origin.latitude_deg);
  let z = Math.max(coverage.minZoom, Math.min(coverage.maxZoom, wanted));
  let block = blockOf(extent, z, frame, coverage);
  while (count(block) > TILES_SEEN_MAX && z > coverage.minZoom) {
    z -= 1;
    block = blockOf(extent, z, frame, coverage);
  }
  if (count(block) > TILES_SEEN_MAX) return [];
  const tiles: Tile[] = [];
  for (let y = block.y0; y <= block.y1; y += 1) {
    for (let x = block.x0; x <= block.x1; x += 1) tiles.push({ z, x, y });
  }
  const middle: Metres = [(extent.min[0] + extent.max[0]) / 2, (extent.min[1] + extent.max[1]) / 2];
  const [mx, my] = toTiles(frame.toLngLat(middle), z);
  const distance = ({ x, y }: Tile) => Math.hypot(x + 0.5 - mx, y + 0.5 - my);
  return tiles.sort((a, b) => distance(a) - distance(b));
}

function count({ x0, x1, y0, y1 }: Block): number {
  return Math.max(0, x1 - x0 + 1) * Math.max(0, y1 - y0 + 1);
}

/** Columns and rows that an extent and the archive have in common. */
function blockOf({ min, max }: Extent, z: number, frame: SiteFrame, coverage: Coverage): Block {
  const xs: number[] = [];
  const ys: number[] = [];
  // The edges of a plan are no parallels: their middles count as well.
  for (const across of [0, 0.5, 1]) {
    for (const up of [0, 0.5, 1]) {
      const at: Metres = [min[0] + across * (max[0] - min[0]), min[1] + up * (max[1] - min[1])];
      const [x, y] = toTiles(frame.toLngLat(at), z);
      xs.push(x);
      ys.push(y);
    }
  }
  const [west, north] = toTiles([coverage.west, coverage.north], z);
  const [east, south] = toTiles([coverage.east, coverage.south], z);
  const last = 2 ** z - 1;
  return {
    x0: Math.max(0, Math.floor(Math.max(west, Math.min(...xs)))),
    x1: Math.min(last, Math.ceil(Math.min(east, Math.max(...xs))) - 1),
    y0: Math.max(0, Math.floor(Math.max(north, Math.min(...ys)))),
    y1: Math.min(last, Math.ceil(Math.min(south, Math.max(...ys))) - 1),
  };
}
