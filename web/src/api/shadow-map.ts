/** Where machines lacked good GNSS: the site's counts, cell by cell. */

import { list, number, object } from "./checking";
import { askFor, withQuery } from "./http";

export interface ShadowCell {
  /** The western and the southern edge, in the site frame. */
  east_m: number;
  north_m: number;
  cell_m: number;
  observed_s: number;
  /** Of that, with fixes that are usable, but not to the centimetre. */
  float_s: number;
  without_gnss_s: number;
  share_without_gnss: number;
}

const properties = object<ShadowCell>({
  east_m: number,
  north_m: number,
  cell_m: number,
  observed_s: number,
  float_s: number,
  without_gnss_s: number,
  share_without_gnss: number,
});

/** The outlines beside it say the same once more. */
const checkShadowMap = object<{ features: { properties: ShadowCell }[] }>({
  features: list(object<{ properties: ShadowCell }>({ properties })),
});

export interface ShadowQuery {
  machine?: string | null;
  from?: string | null;
  to?: string | null;
  cell_m: number;
}

export async function fetchShadow(query: ShadowQuery, signal?: AbortSignal): Promise<ShadowCell[]> {
  const options = signal === undefined ? {} : { signal };
  const { features } = await askFor(withQuery("/api/v1/shadow-map", { ...query }), checkShadowMap, options);
  return features.map((feature) => feature.properties);
}
