/** Aircraft between ticks: they glide to where they should be at the next, and never jump but after a gap. */

/** No aircraft is drawn further ahead of its last report than this. */
const LONGEST_LEAD_S = 2;
/** A jump over more than this is shown as one. */
const JUMP_M = 400;
const METRES_A_DEGREE = 111_320;

export class Motion {
  #tracks = new Map();
  #tickAt = null;
  #tickMs = 1000;

  /** Take the flights of a tick at a time of `performance.now()`; those that are gone are forgotten. */
  take(flights, at, rate) {
    if (this.#tickAt !== null) this.#tickMs = Math.min(2000, Math.max(250, at - this.#tickAt));
    this.#tickAt = at;
    const present = new Map();
    for (const flight of flights) {
      if (flight.position === null) continue;
      const id = flight.flight_intent_id ?? flight.track_id;
      const track = this.#tracks.get(id);
      const target = expected(flight, (this.#tickMs / 1000) * rate);
      const from = track ? between(track, this.#progress(track, at)) : target;
      const jumps = metres(from, target) > Math.max(JUMP_M, JUMP_M * rate);
      present.set(id, {
        flight,
        from: jumps ? target : from,
        to: target,
        began: at,
        heading: headingOf(flight.velocity_mps) ?? track?.heading ?? 0,
      });
    }
    this.#tracks = present;
  }

  /** Return all aircraft as they are to be drawn: `{id, flight, lon, lat, alt_m, heading}`, radians from north. */
  positions(at) {
    return [...this.#tracks].map(([id, track]) => ({
      id, flight: track.flight, heading: track.heading, ...between(track, this.#progress(track, at)),
    }));
  }

  #progress({ began }, at) {
    return Math.min(1, Math.max(0, (at - began) / this.#tickMs));
  }
}

/** Return where an aircraft will be after the next tick, as far as its last report says. */
function expected({ conformance, position, velocity_mps: velocity }, tickS) {
  const { lon, lat, alt_m } = position;
  if (velocity === null || position.airborne === false || conformance === "lost") return { lon, lat, alt_m };
  const lead = Math.min(LONGEST_LEAD_S, position.age_s + tickS);
  return {
    lon: lon + (velocity.east * lead) / (METRES_A_DEGREE * Math.cos((lat * Math.PI) / 180)),
    lat: lat + (velocity.north * lead) / METRES_A_DEGREE,
    alt_m: Math.max(0, alt_m + velocity.up * lead),
  };
}

function between({ from, to }, progress) {
  const mix = (name) => from[name] + (to[name] - from[name]) * progress;
  return { lon: mix("lon"), lat: mix("lat"), alt_m: mix("alt_m") };
}

function metres(one, other) {
  const east = (other.lon - one.lon) * Math.cos((one.lat * Math.PI) / 180);
  return Math.hypot(east, other.lat - one.lat) * METRES_A_DEGREE;
}

/** Return the heading of a velocity, null where it is too slow to have one. */
function headingOf(velocity) {
  if (!velocity || Math.hypot(velocity.east, velocity.north) < 0.5) return null;
  return Math.atan2(velocity.east, velocity.north);
}
