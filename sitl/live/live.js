"use strict";
// Fills the page from the stream. Each message holds the rows that are new, by source, and all the numbers; one that
// says "anew" replaces what is there. Whatever comes from the recording is set as text or drawn, never run.
(() => {
  const described = JSON.parse(document.getElementById("described").textContent);
  const drawing = JSON.parse(document.getElementById("document").textContent);
  const by = (id) => document.getElementById(id);
  const words = {
    connecting: "connecting", waiting: "waiting for a flight", live: "live", silent: "silent: nothing new is written",
    ended: "the flight has ended", damaged: "the recording cannot be read any further",
    lost: "no connection, trying again", paused: "paused",
  };
  const RETRY_MS = [500, 1000, 2000, 5000];
  const SHOWN_EVENTS = 12;
  let doc = null, socket = null, retries = 0, paused = false, following = true, ours = false;
  let modes = [], events = [], now = 0;

  const model = (name) => doc.get_model_by_name(name);
  function tell(state) {
    by("state").textContent = words[state] ?? state;
    by("state").dataset.state = state;
  }

  // numbers

  const dash = "–";
  const fixed = (value, digits, unit = "") => value === null ? dash : value.toFixed(digits) + unit;
  const percent = (value) => value === null ? dash : (100 * value).toFixed(1) + " %";
  function link(way) {
    const all = way.delivered + way.lost;
    const lost = all ? (100 * way.lost / all).toFixed(1) + " % lost" : dash;
    return way.median_ms === null ? lost : `${way.median_ms.toFixed(1)} ms, ${lost}`;
  }
  function delays(counts) {
    const all = counts.reduce((sum, [, n]) => sum + n, 0);
    const most = [...counts].sort((a, b) => b[1] - a[1]).slice(0, 3);
    return all ? most.map(([d, n]) => `${d}: ${Math.round(100 * n / all)} %`).join(", ") : dash;
  }
  function shown(n) {
    const {output, control, window, factors} = described;
    const proved = n.verified ? "proved" : "window";
    const scaled = (value, factor, unit, digits = 2) => value === null ? dash : fixed(value * factor, digits, unit);
    return [
      ["time", fixed(n.time_s, 1, " s")],
      ["flown by", n.mode ?? dash],
      [output.name, scaled(n.y, factors.y, output.unit)],
      [output.reference, scaled(n.yr, factors.y, output.unit)],
      ["error, rms", scaled(n.rms_error, factors.y, output.unit, 3)],
      ["error, largest", scaled(n.max_error, factors.y, output.unit, 3)],
      [control.name, scaled(n.u, factors.u, control.unit)],
      ["delay d", n.d === null ? dash : `${n.d}` + (window ? `, ${proved} ${window[0]}–${window[1]}` : "")],
      ["delays lived", delays(n.delays)],
      ["forecast exact", percent(n.exact_fraction)],
      ["up, median", link(n.link.up)],
      ["down, median", link(n.link.down)],
      ["failsafe events", `${n.failsafe_events}`],
      ["late ticks", `${n.late_ticks}`],
      ["certificate", n.verified === null ? dash : n.verified ? "verified at start" : "none verified"],
    ];
  }
  function tellNumbers(numbers) {
    const list = by("numbers");
    const entries = shown(numbers);
    if (list.children.length !== entries.length) {
      list.replaceChildren(...entries.map(() => {
        const cell = document.createElement("div");
        cell.append(document.createElement("dt"), document.createElement("dd"));
        return cell;
      }));
    }
    entries.forEach(([name, value], at) => {
      list.children[at].children[0].textContent = name;
      list.children[at].children[1].textContent = value;
    });
  }
  function tellEvents() {
    by("events").replaceChildren(...events.slice(-SHOWN_EVENTS).reverse().map(([t, node, text]) => {
      const row = document.createElement("tr");
      for (const value of [t.toFixed(2) + " s", node, text]) {
        const cell = document.createElement("td");
        cell.textContent = value;
        row.append(cell);
      }
      return row;
    }));
  }

  // figures

  const number = (value) => value === null ? NaN : value;
  function scaled(name, values) {
    const factor = described.factors[name] ?? 1;
    return values.map((value) => number(value) * factor);
  }
  function put(name, columns, anew) {
    const source = model(name);
    if (anew) source.data = columns;
    else source.stream(columns, described.rollover);
  }
  function empty(name) {
    return Object.fromEntries(Object.keys(model(name).data).map((column) => [column, []]));
  }
  function draw(rows, anew) {
    for (const name of ["samples", "commands", "up", "down"]) {
      if (rows[name] === undefined && !anew) continue;
      const columns = empty(name);
      for (const column of Object.keys(columns)) columns[column] = scaled(column, rows[name]?.[column] ?? []);
      put(name, columns, anew);
      if (name === "up" || name === "down") {
        const lost = columns.t.filter((_, at) => Number.isNaN(columns.ms[at]));
        if (anew || lost.length) put(name + "-lost", {t: lost}, anew);
      }
    }
    if (anew) modes = [];
    if (rows.modes) rows.modes.t.forEach((t, at) => modes.push([t, rows.modes.mode[at]]));
    modes = modes.slice(-described.rollover);
    model("modes").data = {
      left: modes.map(([t]) => t),
      right: modes.map((_, at) => at + 1 < modes.length ? modes[at + 1][0] : Math.max(now, modes[at][0])),
      mode: modes.map(([, mode]) => mode),
      colour: modes.map(([, mode]) => described.colours[mode] ?? "#808080"),
    };
    if (following) scroll();
    fit();
  }
  function extent(sources) {
    const range = model("time");
    let [low, high] = [Infinity, -Infinity];
    for (const [name, columns] of Object.entries(sources)) {
      const data = model(name).data;
      for (let at = data.t.length - 1; at >= 0; at--) {
        if (data.t[at] < range.start || data.t[at] > range.end) continue;
        for (const column of columns) {
          const value = data[column][at];
          if (value < low) low = value;
          if (value > high) high = value;
        }
      }
    }
    return [low, high];
  }
  function fit() {
    for (const [name, sources] of Object.entries(described.fitted)) {
      let [low, high] = extent(sources);
      if (low > high) continue;
      if (name === "delay") {  // a dead link's delay grows and grows: it may leave the figure
        const usual = Math.max(6, 2 + (described.window?.[1] ?? 0));
        [low, high] = [0, Math.max(usual, Math.min(high, 1.5 * usual))];
      }
      if (name === "link") [low, high] = [-0.15 * high, high];
      const least = described[name]?.unit === "" ? 1e-3 : 0.25;  // a line at rest is not magnified
      const margin = Math.max(0.06 * (high - low), 1e-6 * Math.abs(high), least);
      model(name + "-range").setv({start: low - margin, end: high + margin});
    }
  }
  function takeEvents(rows, anew) {
    if (anew) events = [];
    if (rows.events) rows.events.t.forEach((t, at) => events.push([t, rows.events.node[at], rows.events.text[at]]));
    events = events.slice(-SHOWN_EVENTS);
    tellEvents();
  }
  function scroll() {
    const end = Math.max(now, Math.min(described.window_s, Math.max(10, now * 1.25)));
    ours = true;
    model("time").setv({start: Math.max(Math.min(0, end), end - described.window_s), end});
    ours = false;
  }
  function colour() {
    const style = getComputedStyle(document.documentElement);
    const [text, line] = ["--text", "--line"].map((name) => style.getPropertyValue(name).trim());
    for (const name of described.texts) {
      const part = model(name);
      if ("label_text_color" in part.properties) part.label_text_color = text;
      else part.setv({axis_label_text_color: text, major_label_text_color: text, axis_line_color: line,
        major_tick_line_color: line, minor_tick_line_color: line});
    }
  }

  // the stream

  function take(event) {
    const told = JSON.parse(event.data);
    if (told.run !== described.run || told.flight !== described.flight) {
      location.reload();
      return;
    }
    retries = 0;
    tell(told.state);
    now = told.numbers.time_s;
    if (described.flight) tellNumbers(told.numbers);
    takeEvents(told.rows, told.anew);
    if (doc !== null) draw(told.rows, told.anew);
  }
  function connect() {
    socket = new WebSocket(`ws://${location.host}${described.stream}`);
    const mine = socket;
    socket.onmessage = (event) => { if (mine === socket && !paused) take(event); };
    socket.onclose = () => {
      if (paused || mine !== socket) return;
      tell("lost");
      setTimeout(() => { if (!paused && mine === socket) connect(); }, RETRY_MS[Math.min(retries++, RETRY_MS.length - 1)]);
    };
  }
  function press(id, on) {
    by(id).setAttribute("aria-pressed", String(on));
  }
  by("pause").addEventListener("click", () => {
    paused = !paused;
    press("pause", paused);
    by("pause").textContent = paused ? "Resume" : "Pause";
    if (paused) { socket.close(); tell("paused"); } else connect();  // the snapshot tells what was missed
  });
  by("follow").addEventListener("click", () => {
    following = !following;
    press("follow", following);
    if (following && doc !== null) { scroll(); fit(); }
  });

  async function begin() {
    if (drawing !== null) {
      await Bokeh.embed.embed_item(drawing, "figures");
      doc = Bokeh.documents[0];
      colour();
      matchMedia("(prefers-color-scheme: dark)").addEventListener("change", colour);
      const range = model("time");
      for (const end of ["start", "end"]) {
        range.properties[end].change.connect(() => {
          if (ours) return;
          following = false;
          press("follow", false);
          requestAnimationFrame(fit);
        });
      }
    }
    connect();
  }
  begin();
})();
