/**
 * Tiles that were loaded, those that were used last kept longest, and those that are asked for, a few at a time.
 *
 * When the site does not answer, nothing is asked for a while; a tile that is no picture is taken for one that is
 * not there.
 */

import { type ReadonlySignal, type Signal, signal } from "@preact/signals";

import { type Tile, tileName } from "./mercator";

/** At most so many pixels are kept: 256 tiles of 256 by 256, 64 MiB. */
export const PIXELS_MAX = 256 * 256 * 256;
/** At most so many tiles are remembered, those that are not there among them. */
export const TILES_MAX = 4096;
/** At most so many tiles are asked for at once. */
export const LOADING_MAX = 6;
/** The site is left alone for so long after it did not answer. */
export const RETRY_MS = 10_000;

/** A tile is there, but is no picture. */
export class BadTile extends Error {}

export interface Picture {
  readonly width: number;
  readonly height: number;
  /** Lets its memory go. */
  close(): void;
}

/** `null` where there is no such tile. */
export type Load<P extends Picture> = (tile: Tile) => Promise<P | null>;

export class TileStore<P extends Picture> {
  private readonly failed: Signal<unknown> = signal(null);
  /** What was loaded, in the order of its last use. */
  private readonly kept = new Map<string, P | null>();
  private readonly loading = new Set<string>();
  private readonly listeners = new Set<() => void>();
  private wanted: readonly Tile[] = [];
  private wantedNames = new Set<string>();
  private pixels = 0;
  private side: number | null = null;
  private pause: ReturnType<typeof setTimeout> | null = null;
  /** Since the last pause nothing was loaded yet. */
  private retrying = false;

  constructor(
    private readonly load: Load<P>,
    private readonly pixelsMax = PIXELS_MAX,
  ) {}

  /** Why tiles are missing; `null` while all is well. */
  get failure(): ReadonlySignal<unknown> {
    return this.failed;
  }

  /** How wide the pictures are; `null` until the first has come. */
  get side_px(): number | null {
    return this.side;
  }

  /** Calls back whenever a tile has come, until what is returned is called. */
  whenChanged(listener: () => void): () => void {
    this.listeners.add(listener);
    return () => this.listeners.delete(listener);
  }

  /** The tile's picture, if it was loaded: it counts as used now. */
  get(tile: Tile): P | null {
    const name = tileName(tile);
    const picture = this.kept.get(name);
    if (picture === undefined) return null;
    this.kept.delete(name);
    this.kept.set(name, picture);
    return picture;
  }

  /** What is seen now, what matters most first: loads what is missing of it, and nothing else any more. */
  want(tiles: readonly Tile[]): void {
    this.wanted = tiles;
    this.wantedNames = new Set(tiles.map(tileName));
    this.next();
  }

  private next(): void {
    if (this.pause !== null) return;
    for (const tile of this.wanted) {
      if (this.loading.size >= LOADING_MAX) return;
      const name = tileName(tile);
      if (!this.kept.has(name) && !this.loading.has(name)) void this.fetch(tile, name);
    }
  }

  private async fetch(tile: Tile, name: string): Promise<void> {
    this.loading.add(name);
    try {
      const picture = await this.load(tile);
      if (this.retrying) this.failed.value = null;
      this.retrying = false;
      this.keep(name, picture);
    } catch (error) {
      this.failed.value ??= error;
      if (error instanceof BadTile) this.keep(name, null);
      else this.rest();
    }
    this.loading.delete(name);
    for (const listener of this.listeners) listener();
    this.next();
  }

  private rest(): void {
    this.retrying = false;
    this.pause ??= setTimeout(() => {
      this.pause = null;
      this.retrying = true;
      this.next();
    }, RETRY_MS);
  }

  private keep(name: string, picture: P | null): void {
    this.kept.set(name, picture);
    this.pixels += sizeOf(picture);
    if (picture !== null) this.side ??= picture.width;
    for (const [oldest, old] of this.kept) {
      if (this.pixels <= this.pixelsMax && this.kept.size <= TILES_MAX) return;
      if (this.wantedNames.has(oldest)) continue;
      this.kept.delete(oldest);
      this.pixels -= sizeOf(old);
      old?.close();
    }
  }
}

function sizeOf(picture: Picture | null): number {
  return picture === null ? 0 : picture.width * picture.height;
}
