/** The sensors that ever spoke: rates, ages, refusals. */

import { Fragment } from "preact";

import type { SensorHealth } from "../api/types";
import { useSpeech } from "../text";
import { TableHead } from "./table-head";

interface TableProps {
  sensors: SensorHealth[];
  /** Age of the report itself, on top of the ages in it. */
  extraAge_s: number | null;
  stale: boolean;
}

export function SensorTable({ sensors, extraAge_s, stale }: TableProps) {
  const { text, format } = useSpeech();
  if (sensors.length === 0) return <p class="empty">{text.details.noSensors}</p>;
  return (
    <table class={`sensors${stale ? " stale" : ""}`}>
      <TableHead
        names={[
          text.details.sensorName,
          text.details.rate,
          text.details.ageColumn,
          text.details.received,
          text.details.refused,
        ]}
      />
      <tbody>
        {sensors.map((sensor) => (
          <Fragment key={sensor.sensor}>
            <tr>
              <th scope="row">{text.sensor[sensor.sensor]}</th>
              <td>{format.rate(sensor.rate_hz)}</td>
              <td>{format.age(sensor.age_s === null ? null : sensor.age_s + (extraAge_s ?? 0))}</td>
              <td>{format.count(sensor.received)}</td>
              <td class={sensor.refused > 0 ? "refused" : ""}>{format.count(sensor.refused)}</td>
            </tr>
            {sensor.last_refusal !== null && (
              <tr class="refusal">
                <td colSpan={5}>
                  {text.details.lastRefusal}: {sensor.last_refusal}
                </td>
              </tr>
            )}
          </Fragment>
        ))}
      </tbody>
    </table>
  );
}
