/** The ops console: fetches the airspace once, follows the event stream, and ties map, panels and timeline together. */

import { AlertsPanel } from "/console/alerts.js";
import { aborted, get } from "/console/api.js";
import { CityMap, HEAT_RAMP } from "/console/city_map.js";
import { Closing } from "/console/closing.js";
import { ConstraintsPanel, constraintsAt, isInForce, middleOf } from "/console/constraints.js";
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
import { Reopening } from "/console/reopening.js";
import { scopes, startSession } from "/console/session.js";
import { listenToKeys } from "/console/shortcuts.js";
import { follow } from "/console/stream.js";
import { symbolCanvas } from "/console/symbols.js";
import { startTheme, toggleTheme } from "/console/theme.js";
import { clockTime } from "/console/time.js";
import { Timeline } from "/console/timeline.js";
import { showAirspace, showCounts, showFailure, showLink } from "/console/top_bar.js";
import { Traffic } from "/console/traffic.js";
import { CONFORMANCE_WORDS, STATUS_WORDS, flightName, journalWords } from "/console/words.js";

const TABS = ["alerts", "flights", "details", "new", "airspace"];
const CLOSES = "airmatrix.admin";
const WIDE_PX = 1200;
const FRAME_MS = 33;
const REFRESH_MS = 500;
const HEAT_MS = 10_000;
const NOTICE_MS = 8_000;
/** So near, in pixels, a click means a corner that is there. */
const SAME_CORNER_PX = 10;

class Console {
  #picture = new Picture();
  #grid;
  #city;
  #traffic;
  #filters;
  #timeline;
  #alerts;
  #flights;
  #details;
  #newFlight;
  #closing;
  #reopening;
  #constraintsPanel;
  /** The constraints in force and to come, and the ids of those on the map. */
  #constraints = [];
  #constraintsRequest = null;
  #closed = "";
  #drawnArea = "null";
  /** `{kind: "flight" | "track", id}`, `{kind: "block", block}` or null. */
  #selection = null;
  /** `{blocks, counts, flying, constraints}` of a moment other than the present; null while live. */
  #moment = null;
  #momentRequest = null;
  #heatRequest = null;
  #names = new Map();

  /** Read what does not change, draw the map, then follow the stream. */
  async start() {
    startTheme(() => this.#paint());
    startSession();
    const [airspace, buildings] = await Promise.all([get("/v1/airspace"), get("/v1/airspace/buildings")]);
    showAirspace(airspace);
    this.#grid = new Grid(airspace);
    this.#city = await CityMap.open(byId("map"), this.#grid, airspace.bounds, buildings);
    const [west, south, east, north] = airspace.bounds;
    const frame = new LocalFrame((west + east) / 2, (south + north) / 2);
    this.#traffic = new Traffic(this.#city.map, frame, this.#grid, palette(), byId("tags"));
    this.#addControls();
    this.#addPanels();
    this.#addLegend();
    byId("legend").open = innerWidth >= WIDE_PX;
    this.#listenToMap();
    this.#listenToKeys();
    this.#listenToPicture();
    this.#openTab("alerts");
    setInterval(() => this.#refresh(), REFRESH_MS);
    setInterval(() => {
      if (this.#filters.heatSpan !== null && this.#moment === null) this.#showHeat();
    }, HEAT_MS);
    requestAnimationFrame((at) => this.#animate(at));
    this.#newFlight.load().catch((error) => this.#notice(`Aircraft types: ${error.message}`));
    follow({
      onOpen: () => this.#picture.opened(),
      onLost: () => this.#picture.lost(),
      onEvent: (event, data) => this.#picture.take(event, data),
      onRefused: (why) => this.#picture.refused(why),
    });
  }

  // ---- what is on the screen

  #addControls() {
    this.#filters = new Filters({
      layers: byId("layers"),
      statuses: byId("statuses"),
      heat: byId("heat"),
      span: byId("heat-span"),
      options: byId("heat-options"),
    }, this.#grid, () => {
      this.#showBlocks();
      this.#showHeat();
    });
    document.querySelector(".ramp").style.background = `linear-gradient(to right, ${HEAT_RAMP.join(", ")})`;
    this.#timeline = new Timeline({
      slider: byId("moment"),
      live: byId("live"),
      earlier: byId("earlier"),
      later: byId("later"),
      text: byId("moment-text"),
    }, () => this.#picture.now, (moment) => this.#showMoment(moment));
    byId("theme").addEventListener("click", toggleTheme);
    for (const tab of TABS) byId(`tab-${tab}`).addEventListener("click", () => this.#openTab(tab));
    navigable(document.querySelector(".tabs"), { next: "ArrowRight", previous: "ArrowLeft" });
  }

  #addPanels() {
    const now = () => this.#picture.now;
    const choose = (selection) => this.#choose(selection);
    this.#alerts = new AlertsPanel(byId("alerts-list"), byId("announcer"), (alert) => this.#goTo(alert));
    this.#flights = new FlightsPanel({
      list: byId("flights-list"),
      more: byId("flights-more"),
      search: byId("flights-search"),
      conformance: byId("flights-conformance"),
    }, palette(), (flight) => this.#goTo(flight));
    this.#details = new Details(byId("details"), this.#grid, palette(), {
      choose,
      now,
      showPath: (intent) => this.#traffic.showPath(intent.trajectory, intent.reservations),
      flight: (id) => this.#picture.flights.find((flight) => idOf(flight) === id) ?? null,
      entry: (key) => this.#blocks().get(key) ?? null,
      constraint: (id) => this.#constraints.find((each) => each.id === id)?.name ?? id,
      fail: (error) => this.#notice(error.message),
    });
    this.#constraintsPanel = new ConstraintsPanel(byId("constraints"), byId("constraints-list"),
      (constraint) => this.#city.flyTo(middleOf(constraint)));
    this.#newFlight = new NewFlight(this.#grid, {
      choose,
      now,
      pick: (end) => this.#pickEnd(end),
      showEnds: (ends) => this.#traffic.showEnds(ends),
      showPath: (intent, preview) => this.#traffic.showPath(intent.trajectory, intent.reservations, { preview }),
    });
    this.#closing = new Closing(this.#grid, {
      choose,
      now,
      draw: (hint) => this.#drawArea(hint),
      show: (area) => this.#showArea(area),
      closed: () => this.#loadConstraints(),
      name: (id) => this.#names.get(id) ?? null,
    });
    this.#reopening = new Reopening({
      find: (constraint) => this.#city.flyTo(middleOf(constraint)),
      reopened: () => this.#loadConstraints(),
    });
  }

  #addLegend() {
    const colours = palette();
    const blocks = ["green", "yellow", "red"].map((status) => statusChip(status, `block ${STATUS_WORDS[status]}`));
    const aircraft = [...Object.entries(CONFORMANCE_WORDS), ["planned", "by plan"]].map(([symbol, words]) =>
      [symbolCanvas(symbol, colours), `aircraft ${words}`]);
    byId("legend-list").replaceChildren(...[...blocks.map((chip) => [chip]), ...aircraft].map((parts) =>
      element("li", {}, ...parts)));
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

  /** Take the colours of another theme. */
  #paint() {
    if (!this.#newFlight) return;
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
    picture.addEventListener("link", () => {
      this.#refresh();
      // What was closed or opened while nobody listened.
      if (picture.connected) this.#loadConstraints();
    });
    picture.addEventListener("tick", () => this.#refresh());
    picture.addEventListener("intent", ({ detail: entry }) => {
      setText(byId("latest"), journalWords(entry));
      if (this.#selection?.id === entry.flight_intent_id) this.#showDetails();
    });
    picture.addEventListener("conformance", ({ detail: entry }) => setText(byId("latest"), journalWords(entry)));
    picture.addEventListener("constraint", ({ detail: entry }) => {
      setText(byId("latest"), journalWords(entry));
      this.#loadConstraints();
    });
  }

  #showLists() {
    const { alerts, flights, now } = this.#picture;
    const worst = alerts.some(({ severity }) => severity === "red") ? "red" : "yellow";
    setText(byId("alerts-count"), String(alerts.length));
    byId("alerts-count").dataset.status = alerts.length ? worst : "";
    setText(byId("flights-count"), String(flights.length));
    if (now !== null) this.#alerts.show(alerts, now, (id) => this.#names.get(id) ?? `flight ${id.slice(-8)}`);
    if (!byId("flights").hidden) this.#flights.show(flights);
  }

  /** Write what time and the connection change. */
  #refresh() {
    const flying = this.#picture.flights.filter(({ position }) => position !== null && position.airborne !== false);
    showLink(this.#picture);
    if (this.#moment) showCounts(this.#moment.counts, this.#moment.flying);
    else if (this.#picture.now !== null) showCounts(this.#picture.counts, flying.length);
    this.#timeline.refresh();
    this.#details.refresh();
    this.#closing.refresh();
    byId("closing-access").hidden = scopes()?.includes(CLOSES) ?? true;
    this.#showConstraints();
  }

  async #loadConstraints() {
    this.#constraintsRequest?.abort();
    this.#constraintsRequest = new AbortController();
    try {
      this.#constraints = await constraintsAt(null, this.#constraintsRequest.signal);
      this.#showConstraints();
    } catch (error) {
      if (!aborted(error)) this.#notice(`Closed airspace: ${error.message}`);
    }
  }

  /** Show what is closed at the time shown: constraints begin and end by themselves. */
  #showConstraints() {
    const time = this.#timeline.moment ?? this.#picture.now;
    if (time === null) return;
    const constraints = this.#moment?.constraints ?? this.#constraints;
    this.#constraintsPanel.show(constraints, time);
    this.#reopening.show(this.#constraints, this.#picture.now);
    const inForce = constraints.filter((constraint) => isInForce(constraint, time));
    const closed = inForce.map(({ id }) => id).join();
    if (closed !== this.#closed) this.#city.showConstraints(inForce);
    this.#closed = closed;
  }

  /** Return the blocks in use at the time shown, by key. */
  #blocks() {
    return this.#moment?.blocks ?? this.#picture.blocks;
  }

  #showBlocks() {
    const isHeat = this.#filters.heatSpan !== null;
    const shown = isHeat ? [] : this.#filters.shown([...this.#blocks().values()]);
    this.#city.showBlocks(shown);
    this.#traffic.showAlarms(shown);
  }

  async #showHeat() {
    this.#heatRequest?.abort();
    const span = this.#filters.heatSpan;
    const base = this.#timeline.moment ?? this.#picture.now;
    if (span === null || base === null) {
      this.#city.showHeat([]);
      return;
    }
    this.#heatRequest = new AbortController();
    const [begin, end] = span < 0 ? [span, 0] : [0, span];
    const [from, to] = [begin, end].map((seconds) => new Date(base + seconds * 1000).toISOString());
    try {
      const { blocks } = await get("/v1/airspace/occupancy", { from, to }, this.#heatRequest.signal);
      const columns = new Map();
      for (const { block: [i, j, k], seconds } of blocks) {
        const [, , before] = columns.get(`${i}/${j}`) ?? [i, j, 0];
        if (this.#filters.showsLayer(k)) columns.set(`${i}/${j}`, [i, j, before + seconds]);
      }
      setText(byId("heat-most"), `${Math.round(this.#city.showHeat([...columns.values()]))} s`);
    } catch (error) {
      if (!aborted(error)) this.#notice(`Heat map: ${error.message}`);
    }
  }

  /** Show another moment; null is the present. */
  async #showMoment(moment) {
    this.#momentRequest?.abort();
    document.body.classList.toggle("elsewhen", moment !== null);
    if (moment === null) {
      this.#takeMoment(null, null);
      return;
    }
    const { signal } = this.#momentRequest = new AbortController();
    try {
      const [{ blocks, counts }, aircraft, constraints] = await Promise.all([
        blocksAt(moment, signal), aircraftAt(moment, signal), constraintsAt(moment, signal),
      ]);
      const byKey = new Map(blocks.map((entry) => [keyOf(entry.block), entry]));
      this.#takeMoment({ counts, blocks: byKey, flying: aircraft.length, constraints }, aircraft);
    } catch (error) {
      if (!aborted(error)) this.#notice(`${clockTime(moment)} UTC: ${error.message}`);
    }
  }

  #takeMoment(moment, aircraft) {
    this.#moment = moment;
    this.#traffic.showPlanned(aircraft);
    this.#showBlocks();
    this.#showHeat();
    this.#refresh();
  }

  #animate(at, drawn = 0) {
    const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
    const due = at - drawn >= (calm ? REFRESH_MS : FRAME_MS);
    if (due && this.#picture.state === "live" && this.#moment === null) this.#traffic.draw();
    requestAnimationFrame((next) => this.#animate(next, due ? at : drawn));
  }

  // ---- choosing

  #choose(selection) {
    this.#selection = selection;
    for (const each of [this.#traffic, this.#alerts, this.#flights]) each.selected = selection?.id ?? null;
    this.#traffic.showBlock(selection?.kind === "block" ? selection.block : null);
    this.#traffic.showPath([], []);
    this.#showDetails();
    if (selection === null) this.#showLists();
    else this.#openTab("details");
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

  #pickEnd(end) {
    if (end !== null && this.#closing.isDrawing) this.#closing.abandon();
    this.#showPicking(end && `Click the ${end} on the map, or press Enter to take the centre. Esc ends this.`);
  }

  #drawArea(hint) {
    const { map } = this.#city;
    if (hint !== null && byId("picking").hidden) map.getCanvas().focus();
    if (hint !== null && this.#newFlight.picking !== null) this.#newFlight.pick(null);
    // The second click of two that end an outline must not zoom; it comes at once after what ended it.
    if (hint === null) setTimeout(() => map.doubleClickZoom.enable());
    else map.doubleClickZoom.disable();
    this.#showPicking(hint);
  }

  /** Show what is being chosen on the map; null: nothing is. */
  #showPicking(hint) {
    byId("map").classList.toggle("picking", hint !== null);
    byId("crosshair").hidden = hint === null;
    byId("picking").hidden = hint === null;
    if (hint !== null) setText(byId("picking"), hint);
  }

  #showArea(area) {
    this.#traffic.showArea(area);
    const drawn = JSON.stringify(area && { ...area, end: null });
    // The city is dear to draw: not for every move of the pointer.
    if (drawn === this.#drawnArea) return;
    this.#drawnArea = drawn;
    this.#city.showDraft(area?.corners ?? [], area?.polygon ?? null, area?.base, area?.top);
  }

  #placeCorner({ lng, lat }) {
    this.#closing.place(lng, lat, (corner) => this.#city.pixelsBetween(corner, [lng, lat]) < SAME_CORNER_PX);
  }

  #listenToMap() {
    const { map } = this.#city;
    map.on("click", ({ point, lngLat }) => {
      if (this.#newFlight.picking !== null) {
        this.#newFlight.place(lngLat.lng, lngLat.lat);
        return;
      }
      if (this.#closing.isDrawing) {
        this.#placeCorner(lngLat);
        return;
      }
      const flight = this.#traffic.at(point);
      const block = this.#city.blockAtPoint(point) ?? this.#grid.blockAt(lngLat.lng, lngLat.lat, 0);
      if (flight) this.#choose({ kind: flight.track_id ? "track" : "flight", id: idOf(flight) });
      else this.#choose(block === null ? null : { kind: "block", block });
    });
    map.on("mousemove", ({ point, lngLat }) => {
      if (this.#closing.isDrawing) this.#closing.point([lngLat.lng, lngLat.lat]);
      const flight = this.#isPicking ? null : this.#traffic.at(point);
      this.#traffic.hovered = flight ? idOf(flight) : null;
      map.getCanvas().style.cursor = flight ? "pointer" : "";
      map.getCanvas().title = this.#closed ? this.#city.constraintsAtPoint(point).join(", ") : "";
    });
  }

  #listenToKeys() {
    listenToKeys([
      ["1", "Alerts", () => this.#focusTab("alerts")],
      ["2", "Flights", () => this.#focusTab("flights")],
      ["3", "Details", () => this.#focusTab("details")],
      ["4", "New flight", () => this.#focusTab("new")],
      ["5", "Airspace: what is closed", () => this.#focusTab("airspace")],
      ["C", "Close airspace", () => this.#closeAirspace()],
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
      ["Backspace", "While an area is drawn: take back the last corner", () => this.#takeBack()],
    ], {
      escape: () => this.#escape(),
      enter: () => this.#pickCentre(),
    });
  }

  get #isPicking() {
    return this.#newFlight.picking !== null || this.#closing.isDrawing;
  }

  #pickCentre() {
    if (!this.#isPicking) return false;
    const centre = this.#city.map.getCenter();
    if (this.#closing.isDrawing) this.#placeCorner(centre);
    else this.#newFlight.place(centre.lng, centre.lat);
    return true;
  }

  #escape() {
    if (this.#closing.isDrawing) this.#closing.abandon();
    else if (this.#newFlight.picking !== null) this.#newFlight.pick(null);
    else this.#choose(null);
  }

  #takeBack() {
    if (this.#closing.isDrawing) this.#closing.undo();
  }

  #closeAirspace() {
    this.#openTab("airspace");
    this.#closing.open();
  }

  #focusTab(tab) {
    this.#openTab(tab);
    const fields = [...byId(tab).querySelectorAll("button, input")];
    (fields.find((field) => field.checkVisibility()) ?? byId(`tab-${tab}`)).focus();
  }
}

new Console().start().catch((error) => {
  showFailure(globalThis.maplibregl ? error.message : "MapLibre did not load");
  throw error;
});
