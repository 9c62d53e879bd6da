// Paints the figures in the page's theme, switches it, and makes room on narrow screens.
(() => {
  "use strict";
  const BLUE = "#0072b2";  // the one colour of the figures that is too dark for a dark ground
  const NARROW = 700;
  const root = document.documentElement;
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const button = document.getElementById("theme");
  const blues = new Set();

  const isDark = () => (root.dataset.theme ? root.dataset.theme === "dark" : dark.matches);
  const colour = (name) => getComputedStyle(root).getPropertyValue("--" + name).trim();
  const models = () => Bokeh.documents.flatMap((doc) => [...doc.all_models]);

  function ground(model, text, blue) {
    const ink = model.tags.includes("ink");
    for (const name of ["line_color", "fill_color"]) {
      if (!(name in model.properties)) continue;
      const value = model[name] && model[name].value;
      if (typeof value !== "string") continue;
      const mine = model.id + name;
      if (value.toLowerCase() === BLUE) blues.add(mine);
      if (ink) model[name] = {value: text};
      else if (blues.has(mine)) model[name] = {value: blue};
    }
  }
  function paint() {
    button.textContent = isDark() ? "Light" : "Dark";
    const [text, soft, blue] = ["text", "soft", "blue"].map(colour);
    for (const model of models()) {
      if ("axis_label_text_color" in model.properties) {
        model.setv({axis_label_text_color: soft, major_label_text_color: soft});
      } else if ("label_text_color" in model.properties && "items" in model.properties) {
        model.setv({label_text_color: text, inactive_fill_color: colour("ground")});
      } else {
        ground(model, text, blue);
      }
    }
  }
  function fit() {
    const narrow = innerWidth < NARROW;
    for (const model of models()) {
      if (model.type === "Legend") model.ncols = narrow ? 2 : Math.max(1, model.items.length);
      if (model.type === "Figure") model.min_border_left = narrow ? 52 : 70;
    }
  }
  function begin() {
    const drawn = document.querySelector("figure [data-root-id]");
    if (!Bokeh.documents.length || !drawn || !drawn.childElementCount) {
      setTimeout(begin, 10);
      return;
    }
    fit();
    paint();
    dark.addEventListener("change", paint);
    matchMedia(`(max-width: ${NARROW - 1}px)`).addEventListener("change", fit);
    button.addEventListener("click", () => {
      root.dataset.theme = isDark() ? "light" : "dark";
      try { localStorage.setItem("lagproof-theme", root.dataset.theme); } catch { /* a page from a file may have none */ }
      paint();
    });
    document.body.dataset.ready = "yes";
  }
  begin();
})();
