/** The ops console: fetches the airspace once, follows the event stream, and ties map, panels and timeline together. */

import { aborted, get } from "/console/api.js";
import { AlertsPanel } from "/console/alerts.js";
import { CityMap, HEAT_RAMP } from "/console/city_map.js";
import { Details } from "/console/details.js";
import { byId, element, navigable, setText, statusChip } from "/console/dom.js";
import { Filters } from "/console/filters.js";
import { FlightsPanel, idOf } from "/console/flights.js";
import { LocalFrame } from "/console/frame.js";
import { Grid, keyOf } from "/console/grid.js";
import { NewFlight } from "/console/new_flight.js";
import { palette } from "/console/palette.js";
import { Picture } from "/console/picture.js";
import { aircraftAt, blocksAt } from "/console/planned.js";
import { follow } from "/console/stream.js";
import { symbolCanvas } from "/console/symbols.js";
import { startTheme, toggleTheme } from "/console/theme.js";
import { clockTime, date, span } from "/console/time.js";
import { Timeline } from "/console/timeline.js";
import { Traffic } from "/console/traffic.js";
import { CONFORMANCE_WORDS, STATUS_WORDS, flightName, journalWords } from "/console/words.js";

const TABS = ["alerts", "flights", "details", "new"];
const FRAME_MS = 33;
const NOTICE_MS = 8_000;
const REFRESH_MS = 500;
const HEAT_MS = 10_000;

class Console {
  #airspace;
  #grid;
  #city;
  #traffic;
  #picture = new Picture();
  #filters;
  #timeline;
  #alerts;
  #flights;
  #details;
  #newFlight;
  /** `{kind: "flight" | "track", id}`, `{kind: "block", block}` or null. */
  #selection = null;
  /** Blocks and counts of a moment other than the present; null while live. */
  #moment = null;
  #momentRequest = null;
  #heatRequest = null;
  #names = new Map();

  /** Read what does not change, draw the map, then follow the stream. */
  async start() {
    startTheme(() => this.#paint());
    const [airspace, buildings] = await Promise.all([get("/v1/airspace"), get("/v1/airspace/buildings")]);
    this.#airspace = airspace;
    this.#describe();
    this.#grid = new Grid(airspace);
    this.#city = await CityMap.open(byId("map"), this.#grid, airspace.bounds, buildings);
    const [west, south, east, north] = airspace.bounds;
    const frame = new LocalFrame((west + east) / 2, (south + north) / 2);
    this.#traffic = new Traffic(this.#city.map, frame, this.#grid, palette(), byId("tags"));
    this.#addPanels();
    this.#addLegend();
    byId("legend").open = innerWidth >= 1200;
    this.#listenToMap();
    this.#listenToKeys();
    this.#listenToPicture();
    this.#openTab("alerts");
    setInterval(() => this.#refresh(), REFRESH_MS);
    setInterval(() => this.#filters.heatSpan && this.#timeline.moment === null && this.#showHeat(), HEAT_MS);
    requestAnimationFrame((at) => this.#animate(at));
    this.#newFlight.load().catch((error) => this.#notice(`Aircraft types: ${error.message}`));
    follow({
      onOpen: () => this.#picture.opened(),
      onLost: () => this.#picture.lost(),
      onEvent: (event, data) => this.#picture.take(event, data),
    });
  }

  // ---- what is on the screen

  #describe() {
    const { name, attribution, licence } = this.#airspace;
    setText(byId("airspace-name"), name);
    document.title = `${name} · AirMatrix`;
    setText(byId("attribution"), `Data: ${[attribution, licence].filter(Boolean).join(" · ")}`);
  }

  #addPanels() {
    const now = () => this.#picture.now;
    const choose = (selection) => this.#choose(selection);
    this.#filters = new Filters({
      layers: byId("layers"), statuses: byId("statuses"), heat: byId("heat"), span: byId("heat-span"), options: byId("heat-options"),
    }, this.#grid, () => {
      this.#showBlocks();
      this.#showHeat();
    });
    this.#timeline = new Timeline({
      slider: byId("moment"), live: byId("live"), earlier: byId("earlier"), later: byId("later"), text: byId("moment-text"),
    }, now, (moment) => this.#showMoment(moment));
    this.#alerts = new AlertsPanel(byId("alerts-list"), byId("announcer"), (alert) => this.#goTo(alert));
    this.#flights = new FlightsPanel({
      list: byId("flights-list"), more: byId("flights-more"), search: byId("flights-search"), conformance: byId("flights-conformance"),
    }, palette(), (flight) => this.#goTo(flight));
    this.#details = new Details(byId("details"), this.#grid, palette(), {
      choose,
      now,
      showPath: (intent) => this.#traffic.showPath(intent.trajectory, intent.reservations),
      flight: (id) => this.#picture.flights.find((flight) => idOf(flight) === id) ?? null,
      entry: (key) => this.#blocks().get(key) ?? null,
      fail: (error) => this.#notice(error.message),
    });
    this.#newFlight = new NewFlight(this.#grid, {
      choose,
      now,
      pick: (end) => this.#showPicking(end),
      showEnds: (ends) => this.#traffic.showEnds(ends),
      showPath: (intent, preview) => this.#traffic.showPath(intent.trajectory, intent.reservations, { preview }),
    });
    for (const tab of TABS) byId(`tab-${tab}`).addEventListener("click", () => this.#openTab(tab));
    navigable(document.querySelector(".tabs"), { next: "ArrowRight", previous: "ArrowLeft" });
    byId("theme").addEventListener("click", toggleTheme);
    byId("help").addEventListener("click", () => byId("help-dialog").showModal());
  }

  #addLegend() {
    const colours = palette();
    byId("legend-list").replaceChildren(
      ...Object.entries(STATUS_WORDS).filter(([status]) => status !== "idle")
        .map(([status, words]) => element("li", {}, statusChip(status, `block ${words}`))),
      ...Object.entries(CONFORMANCE_WORDS).map(([symbol, words]) =>
        element("li", {}, symbolCanvas(symbol, colours, 20), `aircraft ${words}`)),
      element("li", {}, symbolCanvas("planned", colours, 20), "aircraft by plan"));
  }

  #openTab(tab) {
    for (const each of TABS) {
      const button = byId(`tab-${each}`);
      button.setAttribute("aria-selected", String(each === tab));
      button.tabIndex = each === tab ? 0 : -1;
      byId(each).hidden = each !== tab;
    }
    this.#showLists();
  }

  #paint() {
    if (!this.#traffic) return;
    const colours = palette();
    this.#city.setTheme();
    this.#traffic.setColours(colours);
    this.#flights.setColours(colours);
    this.#details.setColours(colours);
    this.#addLegend();
    this.#showLists();
  }

  #notice(text) {
    const notice = element("p", { class: "notice", text });
    byId("notices").append(notice);
    setTimeout(() => notice.remove(), NOTICE_MS);
  }

  // ---- the picture

  #listenToPicture() {
    const picture = this.#picture;
    picture.addEventListener("blocks", () => this.#moment ?? this.#showBlocks());
    picture.addEventListener("flights", () => {
      this.#names = new Map(picture.flights.map((flight) => [idOf(flight), flightName(flight)]));
      this.#traffic.take(picture.flights, picture.rate);
      this.#showLists();
    });
    picture.addEventListener("alerts", () => this.#showLists());
    picture.addEventListener("link", () => this.#refresh());
    picture.addEventListener("tick", () => this.#refresh());
    picture.addEventListener("intent", ({ detail: entry }) => {
      setText(byId("latest"), journalWords(entry));
      if (this.#selection?.id === entry.flight_intent_id) this.#showDetails();
    });
    picture.addEventListener("conformance", ({ detail: entry }) => setText(byId("latest"), journalWords(entry)));
  }

  #showLists() {
    const { alerts, flights, now } = this.#picture;
    setText(byId("alerts-count"), String(alerts.length));
    byId("alerts-count").dataset.status = alerts.some(({ severity }) => severity === "red") ? "red" : alerts.length ? "yellow" : "";
    setText(byId("flights-count"), String(flights.length));
    if (now !== null) this.#alerts.show(alerts, now, (id) => this.#names.get(id) ?? `flight ${id.slice(-8)}`);
    if (!byId("flights").hidden) this.#flights.show(flights);
  }

  /** Write what time and the connection change. */
  #refresh() {
    const { now, rate, simulated, state, silentSeconds, flights } = this.#picture;
    if (now !== null) {
      setText(byId("clock-time"), clockTime(now));
      setText(byId("clock-date"), date(now));
    }
    byId("simulated").hidden = !simulated;
    setText(byId("simulated"), `simulated clock ×${rate}`);
    const silent = silentSeconds === null ? "" : span(silentSeconds);
    byId("link").dataset.state = state;
    setText(byId("link"), { connecting: "Connecting", live: "Live", stale: "Stale", reconnecting: "Reconnecting" }[state]);
    const old = state === "stale" || state === "reconnecting";
    byId("stale").hidden = !old;
    document.body.classList.toggle("old", old);
    if (old) setText(byId("stale"), `Stale since ${silent}: the service is not heard${state === "reconnecting" ? ", connecting again" : ""}.`);
    const flying = flights.filter(({ position }) => position !== null && position.airborne !== false).length;
    if (this.#moment) this.#showCounts(this.#moment.counts, this.#moment.flying);
    else this.#showCounts(this.#picture.counts, flying);
    this.#timeline.refresh();
    this.#details.refresh();
  }

  #showCounts(counts, flying) {
    const list = byId("counts");
    if (!list.firstElementChild) {
      list.append(
        ...["green", "yellow", "red"].map((status) => element("li", { id: `count-${status}`, title: `blocks: ${STATUS_WORDS[status]}` },
          element("span", { class: "mark", "data-status": status, "aria-hidden": "true" }),
          element("b"), element("span", { text: ` ${status}` }))),
        element("li", { id: "count-flights", title: "aircraft in the air" }, element("b"), " flying"));
    }
    for (const status of ["green", "yellow", "red"]) setText(byId(`count-${status}`).querySelector("b"), String(counts[status]));
    setText(byId("count-flights").querySelector("b"), String(flying));
  }

  /** Return the blocks shown, by key. */
  #blocks() {
    return this.#moment?.blocks ?? this.#picture.blocks;
  }

  #showBlocks() {
    const shown = this.#filters.shown([...this.#blocks().values()]);
    const isHeat = this.#filters.heatSpan !== null;
    this.#city.showBlocks(isHeat ? [] : shown);
    this.#traffic.showAlarms(isHeat ? [] : shown);
  }

  async #showHeat() {
    const seconds = this.#filters.heatSpan;
    this.#heatRequest?.abort();
    if (seconds === null) {
      this.#city.showHeat([]);
      return;
    }
    this.#heatRequest = new AbortController();
    const base = this.#timeline.moment ?? this.#picture.now ?? Date.now();
    const [from, to] = [Math.min(base, base + seconds * 1000), Math.max(base, base + seconds * 1000)];
    try {
      const { blocks } = await get("/v1/airspace/occupancy",
        { from: new Date(from).toISOString(), to: new Date(to).toISOString() }, this.#heatRequest.signal);
      const columns = new Map();
      for (const { block: [i, j, k], seconds: use } of blocks) {
        if (this.#filters.showsLayer(k)) columns.set(`${i}/${j}`, [i, j, (columns.get(`${i}/${j}`)?.[2] ?? 0) + use]);
      }
      setText(byId("heat-most"), `${Math.round(this.#city.showHeat([...columns.values()]))} s`);
    } catch (error) {
      if (!aborted(error)) this.#notice(`Heat map: ${error.message}`);
    }
  }

  // ---- another time

  async #showMoment(moment) {
    this.#momentRequest?.abort();
    document.body.classList.toggle("elsewhen", moment !== null);
    if (moment === null) {
      this.#moment = null;
      this.#traffic.showPlanned(null);
      this.#showBlocks();
      this.#showHeat();
      this.#refresh();
      return;
    }
    const { signal } = this.#momentRequest = new AbortController();
    try {
      const { blocks, counts } = await blocksAt(moment, signal);
      this.#moment = { counts, flying: 0, blocks: new Map(blocks.map((entry) => [keyOf(entry.block), entry])) };
      this.#traffic.showPlanned([]);
      this.#showBlocks();
      this.#showHeat();
      this.#refresh();
      const aircraft = await aircraftAt(moment, signal);
      this.#traffic.showPlanned(aircraft);
      this.#moment.flying = aircraft.length;
      this.#refresh();
    } catch (error) {
      if (!aborted(error)) this.#notice(`${clockTime(moment)} UTC: ${error.message}`);
    }
  }

  // ---- choosing

  #choose(selection) {
    this.#selection = selection;
    this.#traffic.selected = selection?.id ?? null;
    this.#traffic.showBlock(selection?.kind === "block" ? selection.block : null);
    this.#traffic.showPath([], []);
    this.#showDetails();
    if (selection !== null) this.#openTab("details");
  }

  #showDetails() {
    const selection = this.#selection;
    if (selection === null) this.#details.clear();
    if (selection?.kind === "flight") this.#details.showFlight(selection.id);
    if (selection?.kind === "track") this.#details.showTrack(selection.id);
    if (selection?.kind === "block") this.#details.showBlock(selection.block);
  }

  /** Select an alert's or a list's flight, and fly there. */
  #goTo({ flight_intent_id: flight, track_id: track, position }) {
    this.#choose(flight ? { kind: "flight", id: flight } : { kind: "track", id: track });
    const shown = this.#picture.flights.find((each) => idOf(each) === (flight ?? track));
    const place = shown?.position ?? position;
    if (place) this.#city.flyTo(place);
  }

  #showPicking(end) {
    byId("map").classList.toggle("picking", end !== null);
    byId("crosshair").hidden = end === null;
    const hint = byId("picking");
    hint.hidden = end === null;
    if (end !== null) setText(hint, `Click the ${end} on the map, or press Enter to take the centre. Esc ends this.`);
  }

  #listenToMap() {
    const { map } = this.#city;
    map.on("click", ({ point, lngLat }) => {
      if (this.#newFlight.picking !== null) {
        this.#newFlight.place(lngLat.lng, lngLat.lat);
        return;
      }
      const flight = this.#traffic.at(point);
      const block = flight ? null : this.#city.blockAtPoint(point) ?? this.#grid.blockAt(lngLat.lng, lngLat.lat, 0);
      if (flight) this.#choose({ kind: flight.track_id ? "track" : "flight", id: idOf(flight) });
      else this.#choose(block === null ? null : { kind: "block", block });
    });
    map.on("mousemove", ({ point }) => {
      const flight = this.#newFlight.picking === null ? this.#traffic.at(point) : null;
      this.#traffic.hovered = flight ? idOf(flight) : null;
      map.getCanvas().style.cursor = flight ? "pointer" : "";
    });
  }

  #animate(at, drawn = 0) {
    const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
    const due = at - drawn >= (calm ? REFRESH_MS : FRAME_MS);
    if (due && this.#picture.state === "live" && this.#moment === null) this.#traffic.draw();
    requestAnimationFrame((next) => this.#animate(next, due ? at : drawn));
  }

  // ---- keys

  #listenToKeys() {
    const shortcuts = [
      ["1", "Alerts", () => this.#focusTab("alerts")],
      ["2", "Flights", () => this.#focusTab("flights")],
      ["3", "Details", () => this.#focusTab("details")],
      ["4", "New flight", () => this.#focusTab("new")],
      ["/", "Find a flight", () => {
        this.#openTab("flights");
        byId("flights-search").focus();
      }],
      ["L", "Show the present", () => this.#timeline.goLive()],
      ["[", "One minute earlier", () => this.#timeline.step(-60)],
      ["]", "One minute later", () => this.#timeline.step(60)],
      ["H", "Heat map", () => this.#filters.toggleHeat()],
      ["F", "Whole airspace", () => this.#city.goHome()],
      ["M", "Move the focus to the map", () => this.#city.map.getCanvas().focus()],
      ["T", "Dark or light", toggleTheme],
      ["?", "This list", () => byId("help-dialog").showModal()],
    ];
    const more = [["Esc", "Close what is open"], ["Enter", "While a place is chosen: take the map's centre"], ["↑ ↓", "Move within a list"]];
    byId("help-list").append(...[...shortcuts, ...more].flatMap(([key, words]) =>
      [element("dt", {}, element("kbd", { text: key })), element("dd", { text: words })]));
    addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || byId("help-dialog").open) return;
      if (event.key === "Escape") this.#escape();
      if (event.target.matches("input:not([type=range]):not([type=checkbox]), select, textarea")) return;
      if (event.key === "Enter" && this.#newFlight.picking !== null && !event.target.matches("button")) {
        const { lng, lat } = this.#city.map.getCenter();
        this.#newFlight.place(lng, lat);
        event.preventDefault();
      }
      const shortcut = shortcuts.find(([key]) => key.toLowerCase() === event.key.toLowerCase());
      if (shortcut) {
        event.preventDefault();
        shortcut[2]();
      }
    });
  }

  #focusTab(tab) {
    this.#openTab(tab);
    (byId(tab).querySelector("button, input") ?? byId(`tab-${tab}`)).focus();
  }

  #escape() {
    if (this.#newFlight.picking !== null) this.#newFlight.pick(null);
    else this.#choose(null);
  }
}

const ramp = document.querySelector(".ramp");
ramp.style.background = `linear-gradient(to right, ${HEAT_RAMP.join(", ")})`;

new Console().start().catch((error) => {
  const words = globalThis.maplibregl ? error.message : "MapLibre did not load";
  byId("stale").hidden = false;
  setText(byId("stale"), `The console cannot start: ${words}. Reload the page to try again.`);
  throw error;
});
