/** The one place that turns values into words for people: units, zones, decimal signs. */

const NO_VALUE = "–";
/** More decimals have no room beside a plot. */
const AXIS_DIGITS_MAX = 5;

export class Format {
  private readonly decimals: Intl.NumberFormat[];
  private readonly whole: Intl.NumberFormat;
  private readonly clock: Intl.DateTimeFormat;
  private readonly dateAndClock: Intl.DateTimeFormat;
  private readonly minutes: Intl.DateTimeFormat;
  private readonly seconds: Intl.DateTimeFormat;
  private readonly dayOnly: Intl.DateTimeFormat;
  private readonly calendarDay: Intl.DateTimeFormat;

  /** `locale` gives the decimal sign and order of dates; `zone` (IANA) is the browser's unless given. */
  constructor(
    locale: string,
    readonly zone?: string,
  ) {
    this.decimals = [0, 1, 2, 3, 4, 5, 6, 7].map(
      (digits) =>
        new Intl.NumberFormat(locale, {
          minimumFractionDigits: digits,
          maximumFractionDigits: digits,
          useGrouping: false,
        }),
    );
    this.whole = new Intl.NumberFormat(locale, { maximumFractionDigits: 0 });
    const dateLocale = locale === "en" ? "en-GB" : locale;
    const timeZone = zone === undefined ? {} : { timeZone: zone };
    const clock = { hour: "2-digit", minute: "2-digit", second: "2-digit", hourCycle: "h23" } as const;
    this.clock = new Intl.DateTimeFormat(dateLocale, { ...clock, ...timeZone, timeZoneName: "short" });
    const short = { hour: "2-digit", minute: "2-digit", hourCycle: "h23" } as const;
    this.minutes = new Intl.DateTimeFormat(dateLocale, { ...short, ...timeZone });
    this.seconds = new Intl.DateTimeFormat(dateLocale, { ...clock, ...timeZone });
    this.dayOnly = new Intl.DateTimeFormat(dateLocale, { day: "numeric", month: "short", ...timeZone });
    this.calendarDay = new Intl.DateTimeFormat("en-CA", { dateStyle: "short", ...timeZone });
    this.dateAndClock = new Intl.DateTimeFormat(dateLocale, {
      year: "numeric",
      month: "short",
      day: "numeric",
      ...clock,
      ...timeZone,
      timeZoneName: "short",
    });
  }

  /** With a fixed number of decimals, never "-0". */
  number(value: number | null, digits: number): string {
    if (value === null || !Number.isFinite(value)) return NO_VALUE;
    const scale = 10 ** digits;
    const rounded = Math.round(value * scale) / scale;
    return (this.decimals[digits] ?? this.whole).format(rounded === 0 ? 0 : rounded);
  }

  /** Ticks of an axis: as many decimals for all as tell them apart from what lies between them. */
  axis(values: readonly number[]): string[] {
    const step = Math.abs((values[1] ?? values[0] ?? 0) - (values.length > 1 ? (values[0] ?? 0) : 0));
    const exact = (digits: number) =>
      values.every(
        (value) => Math.abs(value - Math.round(value * 10 ** digits) / 10 ** digits) <= step / 100,
      );
    let digits = 0;
    while (digits < AXIS_DIGITS_MAX && !exact(digits)) digits += 1;
    return values.map((value) => this.number(value, digits));
  }

  count(value: number): string {
    return this.whole.format(value);
  }

  /** A small length, in the unit people use for it: 8 mm, 2.4 cm, 1.20 m. */
  smallLength(metres: number | null): string {
    if (metres === null || !Number.isFinite(metres)) return NO_VALUE;
    const size = Math.abs(metres);
    if (size < 0.00995) return `${this.number(metres * 1000, size < 0.00095 ? 1 : 0)} mm`;
    if (size < 0.9995) return `${this.number(metres * 100, 1)} cm`;
    return `${this.number(metres, size < 99.95 ? 2 : 0)} m`;
  }

  metres(metres: number | null, digits: number): string {
    return metres === null ? NO_VALUE : `${this.number(metres, digits)} m`;
  }

  /** Length of a scale bar or grid step, always exact. */
  roundLength(metres: number): string {
    if (metres >= 1000) return `${this.plain(metres / 1000)} km`;
    if (metres >= 1) return `${this.plain(metres)} m`;
    return metres >= 0.01 ? `${this.plain(metres * 100)} cm` : `${this.plain(metres * 1000)} mm`;
  }

  /** A compass direction: 007.5°. */
  bearing(degrees: number | null): string {
    if (degrees === null || !Number.isFinite(degrees)) return NO_VALUE;
    const tenths = Math.round((((degrees % 360) + 360) % 360) * 10) % 3600;
    const padding = tenths < 100 ? "00" : tenths < 1000 ? "0" : "";
    return `${padding}${this.number(tenths / 10, 1)}°`;
  }

  degrees(degrees: number | null, digits: number): string {
    return degrees === null ? NO_VALUE : `${this.number(degrees, digits)}°`;
  }

  speed(metresPerSecond: number | null): string {
    return metresPerSecond === null ? NO_VALUE : `${this.number(metresPerSecond, 2)} m/s`;
  }

  rate(hertz: number): string {
    return `${this.number(hertz, hertz < 9.95 ? 1 : 0)} Hz`;
  }

  /** An age: 0.1 s below ten seconds, then whole seconds, then 1:05, 2:03:00. */
  age(seconds: number | null): string {
    if (seconds === null || !Number.isFinite(seconds)) return NO_VALUE;
    if (seconds < 9.95) return `${this.number(Math.max(0, seconds), 1)} s`;
    return seconds < 59.5 ? `${this.number(seconds, 0)} s` : duration(seconds);
  }

  /** A span: 0:42, 12:05, 2:03:00. */
  span(seconds: number | null): string {
    return seconds === null || !Number.isFinite(seconds) ? NO_VALUE : duration(seconds);
  }

  bytes(bytes: number): string {
    if (bytes < 1000) return `${this.whole.format(bytes)} B`;
    const units = ["kB", "MB", "GB", "TB"];
    let value = bytes / 1000;
    let unit = 0;
    while (value >= 999.5 && unit < units.length - 1) {
      value /= 1000;
      unit += 1;
    }
    return `${this.number(value, value < 99.95 ? 1 : 0)} ${units[unit]}`;
  }

  /** Time of day with its zone. */
  timeOfDay(time_ms: number | null): string {
    return time_ms === null ? NO_VALUE : this.clock.format(time_ms);
  }

  /** Date and time of day with its zone. */
  dateTime(time_ms: number | null): string {
    return time_ms === null ? NO_VALUE : this.dateAndClock.format(time_ms);
  }

  /** When something was: the time of day, and the date as well if it was not today. */
  moment(time_ms: number, now_ms: number): string {
    const today = this.calendarDay.format(time_ms) === this.calendarDay.format(now_ms);
    return today ? this.timeOfDay(time_ms) : this.dateTime(time_ms);
  }

  /** For axes, under which the zone is printed once: a time of day, or the date where ticks are days apart. */
  tick(time_ms: number, step_s: number): string {
    if (step_s >= 86_400) return this.dayOnly.format(time_ms);
    return (step_s >= 60 ? this.minutes : this.seconds).format(time_ms);
  }

  /** The zone in which times are told, as it is called at that time. */
  zoneName(time_ms: number): string {
    const parts = this.clock.formatToParts(time_ms);
    return parts.find(({ type }) => type === "timeZoneName")?.value ?? "";
  }

  /** A part of a whole: 12 %. */
  percent(share: number): string {
    const percent = share * 100;
    return `${this.number(percent, percent > 0 && percent < 9.95 ? 1 : 0)} %`;
  }

  private plain(value: number): string {
    return this.number(value, Number.isInteger(Number(value.toFixed(3))) ? 0 : 1);
  }
}

function duration(seconds: number): string {
  const whole = Math.max(0, Math.round(seconds));
  const twoDigits = (value: number) => String(value).padStart(2, "0");
  const [hours, minutes] = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60];
  return hours > 0
    ? `${hours}:${twoDigits(minutes)}:${twoDigits(whole % 60)}`
    : `${minutes}:${twoDigits(whole % 60)}`;
}
