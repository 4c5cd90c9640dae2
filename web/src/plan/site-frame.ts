/** The frame of the site whose picture is shown. */

import { useMemo } from "preact/hooks";

import { SiteFrame } from "../geometry/geodesy";
import { useDesk } from "../store/context";

/** The same object as long as the site's origin is. */
export function useSiteFrame(): SiteFrame | null {
  const { store } = useDesk();
  const world = store.calm.value.site?.world ?? null;
  const key = world === null ? "" : `${world.latitude_deg} ${world.longitude_deg} ${world.altitude_m}`;
  return useMemo(() => (world === null ? null : new SiteFrame(world)), [key]);
}
