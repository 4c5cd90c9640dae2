/** What lies under the plan, as the site has it. */

import { nullable, object, text } from "./checking";
import { askFor } from "./http";

export interface Basemap {
  /** Who is to be named beside it; empty for nobody, `null` for whom the file names. */
  attribution: string | null;
}

export interface SiteMap {
  /** `null` where the site has none. */
  basemap: Basemap | null;
}

export const checkMap = object<SiteMap>({
  basemap: nullable(object<Basemap>({ attribution: nullable(text) })),
});

export function fetchMap(): Promise<SiteMap> {
  return askFor("/api/v1/map", checkMap);
}
