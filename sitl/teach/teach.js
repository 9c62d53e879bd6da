// Puts what belongs to the slider's position in its place. Every number and every word was made in Python.
"use strict";
(() => {
  const FIGURES = ["response", "command", "delay", "left"];
  const PATTERNS = ["constant", "random", "worst"];
  const SYMBOLS = { proved: "✓", refuted: "✗", grows: "✗", undecided: "?", calm: "~" };
  const ROWS = { constant: "always d", random: "at random", worst: "worst case" };
  const EARLY_S = 6;
  const at = (id) => document.getElementById(id);
  const { systems, samples } = JSON.parse(at("lessons").textContent);
  const chosen = { system: 0, pattern: "worst", d: systems[0].first };
  let models = null; // bokeh's, once they are there

  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const floats = (text) => new Float32Array(bytes(text).buffer);
  const system = () => systems[chosen.system];
  const shown = () => system().cases[chosen.pattern][chosen.d - system().first];
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

  function findModels() {
    const found = {};
    for (const document_ of window.Bokeh?.documents ?? []) {
      for (const name of [...FIGURES, "curves", "seconds", "low", "high"]) {
        found[name] ??= document_.get_model_by_name(name);
      }
    }
    return FIGURES.every((name) => found[name]) ? found : null;
  }

  function draw() {
    const own = system();
    const one = shown();
    const t = Float64Array.from({ length: samples }, (_, k) => k * own.Ts);
    const [start, perSample] = one.line;
    models.curves.data = {
      t,
      y: floats(one.y),
      yr: own.yr ? floats(own.yr) : new Float32Array(samples).fill(NaN),
      u: floats(one.u),
      d: Float32Array.from(bytes(one.d)),
      left: floats(one.left),
      line: t.map((_, k) => 10 ** Math.max(-9, Math.min(9, start + perSample * k))),
    };
    models.seconds.end = at("early").checked ? Math.min(EARLY_S, own.seconds) : own.seconds;
    for (const [name, [low, high]] of Object.entries(own.views)) {
      models[name].y_range.setv({ start: low, end: high });
    }
    for (const [name, label] of Object.entries(own.labels)) models[name].left[0].axis_label = label;
    ["low", "high"].forEach((name, i) => {
      models[name].setv({ visible: own.limits !== null, location: own.limits ? own.limits[i] : 0 });
    });
    paint();
  }

  function paint() {
    const [text, soft, line, grid, quiet] = ["text", "soft", "line", "grid", "quiet"].map(colour);
    const curve = colour(shown().grows ? "bad" : "accent");
    for (const name of FIGURES) {
      const figure = models[name];
      for (const axis of [...figure.left, ...figure.below]) {
        axis.setv({
          axis_label_text_color: text, major_label_text_color: soft, axis_line_color: line,
          major_tick_line_color: line, minor_tick_line_color: null, axis_label_text_font_style: "normal",
        });
      }
      for (const item of figure.center) if (item.type === "Grid") item.grid_line_color = grid;
      for (const renderer of figure.renderers) {
        renderer.glyph.line_color = renderer.name === "curve" ? curve : renderer.name === "steps" ? soft : quiet;
      }
    }
    for (const name of ["low", "high"]) models[name].line_color = quiet;
  }

  function say() {
    const own = system();
    const one = shown();
    const ms = +(chosen.d * own.Ts * 1e3).toPrecision(6);
    at("position").textContent = `${chosen.d} ${chosen.d === 1 ? "sample" : "samples"}, ${ms} ms`;
    at("delay").setAttribute("aria-valuetext", at("position").textContent);
    at("verdict").className = one.standing;
    at("symbol").className = `cell ${one.standing}`;
    at("symbol").textContent = SYMBOLS[one.standing];
    for (const name of ["headline", "about", "says"]) at(name).innerHTML = one[name];
    at("numbers").innerHTML = one.numbers.map(([name, value]) => `<dt>${name}</dt><dd>${value}</dd>`).join("");
    at("linename").textContent = chosen.pattern === "random" ? "its growth as measured" : "the growth computed for it";
    document.body.classList.toggle("grows", one.grows);
    for (const button of at("cells").querySelectorAll("button")) {
      const own_ = button.dataset.pattern === chosen.pattern && +button.dataset.d === chosen.d;
      button.setAttribute("aria-pressed", own_);
    }
  }

  function lay() { // what changes with the system only
    const own = system();
    const slider = at("delay");
    slider.min = own.first;
    slider.max = own.last;
    chosen.d = Math.max(own.first, Math.min(own.last, chosen.d));
    slider.value = chosen.d;
    at("takeaway").innerHTML = own.takeaway;
    at("Ts").textContent = `${+(own.Ts * 1e3).toPrecision(6)} ms`;
    const show = (name, yes) => document.querySelectorAll(`.${name}`).forEach((one) => { one.hidden = !yes; });
    show("withref", own.yr !== null);
    show("withlimits", own.limits !== null);
    show("fifo", own.fifo);
    show("any", !own.fifo);
    const heads = own.cases.worst.map((_, i) => `<th scope="col">${own.first + i}</th>`).join("");
    const rows = PATTERNS.map((pattern) => {
      const cells = own.cases[pattern].map((one, i) => {
        const d = own.first + i;
        const label = `${ROWS[pattern]}, d = ${d}: ${one.headline}`;
        return `<td><button type="button" tabindex="-1" class="cell ${one.standing}" data-pattern="${pattern}" data-d="${d}"`
          + ` aria-label="${label}" title="${label}">${SYMBOLS[one.standing]}</button></td>`;
      });
      return `<tr><th scope="row">${ROWS[pattern]}</th>${cells.join("")}</tr>`;
    });
    const caption = at("cells").querySelector("caption").outerHTML;
    at("cells").innerHTML = `${caption}<thead><tr><th scope="col">d</th>${heads}</tr></thead><tbody>${rows.join("")}</tbody>`;
  }

  function choose(change) {
    const before = chosen.system;
    Object.assign(chosen, change);
    if (chosen.system !== before) lay();
    at("system").value = chosen.system;
    at("delay").value = chosen.d;
    document.querySelector(`input[name="pattern"][value="${chosen.pattern}"]`).checked = true;
    say();
    if (models) draw();
    history.replaceState(null, "", `#${encodeURIComponent(system().name)}/${chosen.pattern}/${chosen.d}`);
  }

  function fromAddress() { // #hirm-paper/worst/5 shows it, so that a slide can point at a case
    const [name, pattern, d] = decodeURIComponent(location.hash.slice(1)).split("/");
    const i = systems.findIndex((one) => one.name === name);
    if (i < 0 || !PATTERNS.includes(pattern)) return {};
    const asked = Number.parseInt(d, 10);
    const fits = asked >= systems[i].first && asked <= systems[i].last;
    return { system: i, pattern, d: fits ? asked : systems[i].first };
  }

  function begin() {
    Object.assign(chosen, fromAddress());
    lay();
    choose({});
    at("system").addEventListener("change", (event) => choose({ system: +event.target.value }));
    at("delay").addEventListener("input", (event) => choose({ d: +event.target.value }));
    at("pattern").addEventListener("change", (event) => choose({ pattern: event.target.value }));
    at("early").addEventListener("change", () => models && draw());
    at("cells").addEventListener("click", (event) => {
      const button = event.target.closest("button");
      if (button) choose({ pattern: button.dataset.pattern, d: +button.dataset.d });
    });
    window.addEventListener("hashchange", () => choose(fromAddress()));
    window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => models && paint());
    const wait = () => {
      models = findModels();
      if (!models) return void requestAnimationFrame(wait);
      draw();
      document.body.dataset.ready = "yes";
    };
    wait();
  }

  begin();
})();
