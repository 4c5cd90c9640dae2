/**
 * Holds our types against those generated from the server's OpenAPI description: if they differ, this file does
 * not compile. The generated ones write three numbers as a list, and what may be `null` as optional.
 */

import type { Me, NewToken, Token, User } from "./accounts";
import type { AlertsView } from "./alerts";
import type { components } from "./generated";
import type { SiteMap } from "./map";
import type { OutageDetail, OutagesView, Statistics } from "./outages";
import type { ShadowCell } from "./shadow-map";
import type {
  ConfigurationView,
  EventsAnswer,
  FleetView,
  HistoryView,
  LiveMessage,
  MachineView,
  SessionsView,
  TrackAnswer,
  TrajectoryView,
} from "./types";

type Schemas = components["schemas"];

/** Lists without their length, fields without their question mark. */
type Plain<T> = T extends readonly (infer Item)[]
  ? Plain<Item>[]
  : T extends object
    ? { [Key in keyof T]-?: Plain<Exclude<T[Key], undefined>> }
    : T;

type Same<A, B> = [Plain<A>] extends [Plain<B>] ? ([Plain<B>] extends [Plain<A>] ? true : false) : false;

/** Each is `true`, or this is where the server and the page went apart. */
export type Agreement = [
  Holds<Same<FleetView, Schemas["FleetView"]>>,
  Holds<Same<MachineView, Schemas["MachineView"]>>,
  Holds<Same<LiveMessage, Schemas["LiveMessage"]>>,
  Holds<Same<SessionsView, Schemas["SessionsView"]>>,
  Holds<Same<TrackAnswer, Schemas["TrackAnswer"]>>,
  Holds<Same<EventsAnswer, Schemas["EventsAnswer"]>>,
  Holds<Same<HistoryView, Schemas["HistoryView"]>>,
  Holds<Same<TrajectoryView, Schemas["TrajectoryView"]>>,
  Holds<Same<ConfigurationView, Schemas["ConfigurationView"]>>,
  Holds<Same<OutagesView, Schemas["OutagesView"]>>,
  Holds<Same<OutageDetail, Schemas["OutageDetail"]>>,
  Holds<Same<Statistics, Schemas["Statistics"]>>,
  Holds<Same<ShadowCell, Schemas["ShadowProperties"]>>,
  Holds<Same<SiteMap, Schemas["MapView"]>>,
  Holds<Same<AlertsView, Schemas["AlertsView"]>>,
  Holds<Same<Me, Schemas["MeView"]>>,
  Holds<Same<User, Schemas["UserView"]>>,
  Holds<Same<Token, Schemas["TokenView"]>>,
  Holds<Same<NewToken, Schemas["NewTokenView"]>>,
];

type Holds<T extends true> = T;
