/** The site's basemap: the part of the page that is loaded only where there is one. */

import type { ReadonlySignal } from "@preact/signals";

import type { SiteFrame } from "../geometry/geodesy";
import { openArchive } from "./archive";
import { BasemapLayer } from "./layer";
import { TileStore } from "./tile-store";

export interface OpenBasemap {
  /** Who is to be named beside it; empty for nobody. */
  attribution: string;
  /** Why tiles are missing; `null` while all is well. */
  failure: ReadonlySignal<unknown>;
  /** What a plan in that frame draws; `changed` is called when there is more to draw. */
  layer(frame: SiteFrame, changed: () => void): BasemapLayer;
}

/** Tiles are kept for all plans of the page. */
export async function openBasemap(attribution: string | null): Promise<OpenBasemap> {
  const archive = await openArchive();
  const store = new TileStore(archive.load);
  return {
    attribution: attribution ?? (await archive.attribution()),
    failure: store.failure,
    layer: (frame, changed) => new BasemapLayer(store, archive.coverage, frame, changed),
  };
}
