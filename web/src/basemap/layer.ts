/**
 * Tiles of the site's basemap on a plan. What was drawn once is kept as one picture until the plan is moved or a tile
 * comes: machines move more often than the ground.
 */

import type { SiteFrame } from "../geometry/geodesy";
import type { Backdrop, Camera } from "../plan/view";
import { type Coverage, type Placement, placementOf, type Tile, tilesSeen } from "./mercator";
import type { TileStore } from "./tile-store";

/** As long as no tile has come. */
const TILE_PX = 256;
/** A tile that is not there yet is drawn from one that many zooms coarser at most. */
const COARSER_MAX = 8;
/** Tiles reach so far over their edges, in pixels of the screen: else the ground shines through between them. */
const OVERLAP_PX = 0.5;

/** A part of a picture, in its pixels. */
type Part = readonly [x: number, y: number, width: number, height: number];

export class BasemapLayer implements Backdrop {
  private readonly picture = document.createElement("canvas");
  private readonly context = this.picture.getContext("2d");
  private readonly stopListening: () => void;
  /** What the picture shows; empty when it has to be drawn anew. */
  private drawn = "";

  constructor(
    private readonly store: TileStore<ImageBitmap>,
    private readonly coverage: Coverage,
    private readonly frame: SiteFrame,
    changed: () => void,
  ) {
    this.stopListening = store.whenChanged(() => {
      this.drawn = "";
      changed();
    });
  }

  paint(onto: CanvasRenderingContext2D, camera: Camera): void {
    const wanted = JSON.stringify(camera);
    if (wanted !== this.drawn) {
      this.drawn = wanted;
      this.compose(camera);
    }
    const { width, height } = this.picture;
    onto.drawImage(this.picture, 0, 0, width / camera.ratio, height / camera.ratio);
  }

  destroy(): void {
    this.stopListening();
    this.store.want([]);
  }

  private compose(camera: Camera): void {
    const { centre, metresPerPixel, width_px, height_px, ratio } = camera;
    const { context } = this;
    if (context === null) return;
    // Setting the size empties the picture, and puts its drawing state back.
    this.picture.width = Math.max(1, Math.round(width_px * ratio));
    this.picture.height = Math.max(1, Math.round(height_px * ratio));
    const [east_m, north_m] = [(width_px / 2) * metresPerPixel, (height_px / 2) * metresPerPixel];
    const extent = {
      min: [centre[0] - east_m, centre[1] - north_m],
      max: [centre[0] + east_m, centre[1] + north_m],
    } as const;
    const tiles = tilesSeen(extent, metresPerPixel, this.store.side_px ?? TILE_PX, this.frame, this.coverage);
    this.store.want(tiles);
    for (const tile of tiles) this.drawBest(context, tile, camera);
  }

  /** The tile, or as long as it is missing, what there is of coarser or finer ones. */
  private drawBest(context: CanvasRenderingContext2D, tile: Tile, camera: Camera): void {
    const picture = this.store.get(tile);
    if (picture !== null) {
      this.drawPart(context, tile, picture, [0, 0, picture.width, picture.height], camera);
      return;
    }
    for (let up = 1; up <= Math.min(COARSER_MAX, tile.z - this.coverage.minZoom); up += 1) {
      const side = 2 ** up;
      const [x, y] = [Math.floor(tile.x / side), Math.floor(tile.y / side)];
      const coarser = this.store.get({ z: tile.z - up, x, y });
      if (coarser === null) continue;
      const [width, height] = [coarser.width / side, coarser.height / side];
      const part: Part = [(tile.x - x * side) * width, (tile.y - y * side) * height, width, height];
      this.drawPart(context, tile, coarser, part, camera);
      return;
    }
    for (const [right, down] of [
      [0, 0],
      [1, 0],
      [0, 1],
      [1, 1],
    ] as const) {
      const finer = { z: tile.z + 1, x: 2 * tile.x + right, y: 2 * tile.y + down };
      const there = this.store.get(finer);
      if (there !== null) this.drawPart(context, finer, there, [0, 0, there.width, there.height], camera);
    }
  }

  private drawPart(
    context: CanvasRenderingContext2D,
    tile: Tile,
    picture: ImageBitmap,
    part: Part,
    camera: Camera,
  ): void {
    const placement = placementOf(tile, this.frame);
    const { corner, right, down } = placement;
    const { centre, metresPerPixel, width_px, height_px, ratio } = camera;
    const scale = ratio / metresPerPixel;
    context.setTransform(
      right[0] * scale,
      -right[1] * scale,
      down[0] * scale,
      -down[1] * scale,
      ratio * (width_px / 2) + (corner[0] - centre[0]) * scale,
      ratio * (height_px / 2) - (corner[1] - centre[1]) * scale,
    );
    const over = OVERLAP_PX / (sideOf(placement) * scale);
    context.drawImage(picture, ...part, -over, -over, 1 + 2 * over, 1 + 2 * over);
  }
}

function sideOf({ right }: Placement): number {
  return Math.hypot(right[0], right[1]);
}
