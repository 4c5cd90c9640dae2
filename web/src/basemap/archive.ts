/** The site's PMTiles file, read by ranges: what it holds, and its tiles as pictures. */

import { EtagMismatch, PMTiles, type RangeResponse, type Source, tileTypeExt } from "pmtiles";

import { ApiError, ask } from "../api/http";
import { attributionOf } from "./attribution";
import type { Coverage, Tile } from "./mercator";
import { BadTile } from "./tile-store";

const PATH = "/api/v1/basemap.pmtiles";

const KINDS: Record<string, string> = {
  ".png": "image/png",
  ".jpg": "image/jpeg",
  ".webp": "image/webp",
};

export interface Archive {
  coverage: Coverage;
  /** In the file's own words; empty if it has none. */
  attribution(): Promise<string>;
  /** `null` where it has no such tile. */
  load(tile: Tile): Promise<ImageBitmap | null>;
}

/** Ranges of the file, by the door through which the page asks for everything. */
class SiteSource implements Source {
  getKey(): string {
    return PATH;
  }

  async getBytes(
    offset: number,
    length: number,
    signal?: AbortSignal,
    etag?: string,
  ): Promise<RangeResponse> {
    const headers = { range: `bytes=${offset}-${offset + length - 1}`, accept: "*/*" };
    let response: Response;
    try {
      response = await ask(PATH, signal === undefined ? { headers } : { headers, signal });
    } catch (error) {
      // Shorter than what its directories said: it is another file now.
      if (error instanceof ApiError && error.status === 416 && etag !== undefined) {
        throw new EtagMismatch(error.message);
      }
      throw error;
    }
    if (response.status !== 206) {
      await response.body?.cancel();
      throw new Error("something on the way to the site does not pass on ranges of files");
    }
    const tag = response.headers.get("etag") ?? undefined;
    if (etag !== undefined && tag !== etag) {
      await response.body?.cancel();
      throw new EtagMismatch(`the basemap was ${etag}, is ${tag}`);
    }
    const data = await response.arrayBuffer();
    return tag === undefined ? { data } : { data, etag: tag };
  }
}

export async function openArchive(): Promise<Archive> {
  const file = new PMTiles(new SiteSource());
  const header = await file.getHeader();
  const kind = KINDS[tileTypeExt(header.tileType)];
  if (kind === undefined) throw new Error("its tiles are no pictures");
  // Who leaves the bounds out leaves zeros.
  const isBounded = header.minLon < header.maxLon && header.minLat < header.maxLat;
  const coverage: Coverage = {
    minZoom: header.minZoom,
    maxZoom: header.maxZoom,
    west: isBounded ? header.minLon : -180,
    south: isBounded ? header.minLat : -90,
    east: isBounded ? header.maxLon : 180,
    north: isBounded ? header.maxLat : 90,
  };
  return {
    coverage,
    async attribution() {
      try {
        return attributionOf(await file.getMetadata());
      } catch (error) {
        // Metadata that are no JSON name nobody.
        if (error instanceof SyntaxError) return "";
        throw error;
      }
    },
    async load({ z, x, y }) {
      const found = await file.getZxy(z, x, y);
      if (found === undefined) return null;
      try {
        return await createImageBitmap(new Blob([found.data], { type: kind }));
      } catch (error) {
        throw new BadTile(`tile ${z}/${x}/${y}: ${error instanceof Error ? error.message : error}`);
      }
    },
  };
}
