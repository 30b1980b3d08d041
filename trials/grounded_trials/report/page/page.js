"use strict";
(() => {
  const all = (selector, from = document) => [...from.querySelectorAll(selector)];
  const { panels, colours } = JSON.parse(document.getElementById("data").textContent);
  const night = matchMedia("(prefers-color-scheme: dark)");
  const plots = all(".plot");
  const hidden = new Map(); // for each figure, the names switched off in its legend
  let light = false; // true while printing
  let folded = []; // parts of the page that are opened for printing only
  const SHEET = 330; // width of a panel on paper [px]
  let time = 0;

  // Values: decode typed arrays, replace roles by colours.
  const array = ({ bdata }) =>
    new Float32Array(Uint8Array.from(atob(bdata), (c) => c.charCodeAt(0)).buffer);
  const unpacked = (value) => {
    if (Array.isArray(value)) return value.map(unpacked);
    if (value === null || typeof value !== "object") return value;
    if (value.bdata !== undefined) return array(value);
    return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, unpacked(item)]));
  };
  const dark = () => night.matches && !light;
  const coloured = (value) => {
    if (Array.isArray(value)) return value.map(coloured);
    if (typeof value === "string" && value[0] === "@") {
      const [role, opacity] = value.slice(1).split("/");
      const colour = colours[role][dark() ? 1 : 0];
      if (!opacity) return colour;
      const rgb = [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16));
      return `rgba(${rgb},${opacity})`;
    }
    if (value === null || typeof value !== "object" || ArrayBuffer.isView(value)) return value;
    return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, coloured(item)]));
  };

  // Drawing: each panel is drawn when it first comes into view.
  const known = (plot) => {
    const panel = panels[plot.dataset.panel];
    if (!panel.ready) {
      for (const key of ["data", "layout"]) panel[key] = unpacked(panel[key] || []);
      panel.ready = true;
      panel.home = [...panel.layout.xaxis.range];
    }
    return panel;
  };
  const off = (plot) => hidden.get(plot.closest(".figure")) || new Set();
  const looks = (plot) => {
    const { data, layout, kind } = known(plot);
    const gone = off(plot);
    const shown = data.filter((trace) => trace.meta.style !== "ghost"); // ghosts only move marks
    const traces = coloured(shown).map((trace) => {
      const name = trace.name || trace.meta.trial;
      return gone.has(name) || gone.has(trace.meta.trial) ? { ...trace, visible: false } : trace;
    });
    const own = plot.layout || {};
    const shared = {
      showlegend: false, autosize: true, dragmode: "zoom",
      hovermode: kind === "time" || kind === "forecast" ? "x unified" : "closest",
      margin: { l: 8, r: 12, t: 6, b: 8, pad: 2 }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { color: coloured("@text"), size: 12 }, hoverlabel: { namelength: -1, font: { size: 12 } },
      modebar: { bgcolor: "rgba(0,0,0,0)", color: "#888", activecolor: coloured("@best") },
    };
    const zoomed = {};
    for (const axis of ["xaxis", "yaxis"]) {
      zoomed[axis] = { ...coloured(layout[axis]), ...(own[axis] && plot.zoomed ? { range: own[axis].range } : {}) };
    }
    return [traces, { ...shared, ...coloured(layout), ...zoomed }];
  };
  const config = {
    displaylogo: false, responsive: true, doubleClick: "reset",
    displayModeBar: "hover",
    modeBarButtons: [["zoom2d", "pan2d", "zoomIn2d", "zoomOut2d", "resetScale2d", "toImage"]],
  };
  const draw = (plot) => {
    const first = !plot.drawn;
    plot.drawn = true;
    Plotly.react(plot, ...looks(plot), config);
    if (!first) return;
    const { kind } = panels[plot.dataset.panel];
    const placed = () => {
      marks(plot);
      for (const button of all(".modebar-btn", plot)) button.tabIndex = -1; // plots have keyboard shortcuts
    };
    plot.on("plotly_afterplot", placed);
    plot.on("plotly_relayout", (change) => zoomedTo(plot, kind, change));
    if (kind === "time") {
      plot.on("plotly_hover", (event) => point(event.xvals ? event.xvals[0] : event.points[0].x, plot));
    } else if (kind === "path") {
      plot.on("plotly_hover", ({ points: [at] }) => at.customdata !== undefined && point(at.customdata, plot));
    }
    plot.addEventListener("keydown", (event) => keyed(plot, event));
    placed();
  };
  const waiting = []; // one panel per frame, so that the page remains responsive
  const next = () => {
    const plot = waiting.shift();
    if (plot && !plot.drawn) draw(plot);
    if (waiting.length) requestAnimationFrame(next);
  };
  const seen = new IntersectionObserver((entries) => {
    const idle = !waiting.length;
    waiting.push(...entries.filter((e) => e.isIntersecting && !e.target.drawn).map((e) => e.target));
    if (idle && waiting.length) requestAnimationFrame(next);
  }, { rootMargin: "300px" });

  // Zoom: panels over time share their range; keys do what the mouse does.
  const zoomedTo = (plot, kind, change) => {
    if (!Object.keys(change).some((key) => /^[xy]axis/.test(key))) return;
    plot.zoomed = true;
    if (kind !== "time" && kind !== "forecast") return;
    const own = plot.layout.xaxis.range, figure = plot.closest(".figure");
    const { home } = known(plot), whole = own[0] === home[0] && own[1] === home[1]; // each has its own
    for (const other of kind === "time" ? plots : all(".plot", figure)) {
      if (other === plot || panels[other.dataset.panel].kind !== kind) continue;
      const { xaxis } = other.drawn ? other.layout : known(other).layout;
      const range = whole ? known(other).home : own;
      if (xaxis.range[0] === range[0] && xaxis.range[1] === range[1]) continue;
      if (other.drawn) Plotly.relayout(other, { "xaxis.range": [...range] });
      else xaxis.range = [...range];
    }
  };
  const keyed = (plot, event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "s") Plotly.downloadImage(plot, { filename: plot.id });
    const axis = plot.layout.xaxis;
    const [low, high] = axis.range;
    const span = high - low, middle = (low + high) / 2;
    const to = {
      "+": [middle - span / 4, middle + span / 4], "-": [middle - span, middle + span],
      ArrowLeft: [low - span / 5, high - span / 5], ArrowRight: [low + span / 5, high + span / 5],
      0: known(plot).home,
    }[event.key];
    if (!to) return;
    event.preventDefault();
    Plotly.relayout(plot, { "xaxis.range": [...to] });
  };

  // The cursor: one time in all panels, drawn as a line or as marks on the paths.
  const over = (plot, name, kind) => {
    let mark = plot.querySelector(`:scope > .over[data-name="${name}"]`);
    if (!mark) {
      mark = document.createElement("i");
      mark.className = kind;
      mark.dataset.name = name;
      if (kind.includes("cross")) mark.textContent = "×";
      plot.append(mark);
    }
    return mark;
  };
  const put = (plot, mark, x, y) => {
    const { xaxis, yaxis } = plot._fullLayout;
    const left = xaxis.l2p(x), top = y === undefined ? 0 : yaxis.l2p(y);
    const inside = left >= -1 && left <= xaxis._length + 1 && top >= -1 && top <= yaxis._length + 1;
    mark.hidden = !inside;
    mark.style.left = `${xaxis._offset + left}px`;
    mark.style.top = `${yaxis._offset + top}px`;
    if (y === undefined) mark.style.height = `${yaxis._length}px`;
  };
  const between = (t) => { // returns a linear interpolator at the cursor's time
    if (!t || !t.length || time > t[t.length - 1] + 1e-9) return null;
    let low = 0, high = t.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (t[middle] <= time) low = middle; else high = middle;
    }
    const part = t[high] > t[low] ? Math.min(1, Math.max(0, (time - t[low]) / (t[high] - t[low]))) : 0;
    return (values) => values[low] + part * (values[high] - values[low]);
  };
  const at = ({ x, y, customdata: t }) => {
    const now = between(t), place = now && [now(x), now(y)];
    return place && place.every(Number.isFinite) ? place : null;
  };
  const which = document.getElementById("which");
  const parts = [
    ["desired", "over at mark cross desired", ({ meta }) => meta.role === "desired"],
    ["predicted", "over at mark ring predicted", ({ meta }) => meta.role === "predicted" && meta.trial === which.value],
    ["real", "over at mark disc real", ({ meta }) => meta.trial === which.value && meta.style === "line"],
  ];
  const marks = (plot) => {
    const { kind, data } = known(plot);
    if (!plot._fullLayout || !which) return;
    if (kind === "time") put(plot, over(plot, "time", "over line"), time);
    if (kind !== "path" || !data.some((trace) => trace.meta.trial === which.value)) return;
    for (const [name, look, fits] of parts) {
      const trace = data.find((one) => fits(one) && one.customdata);
      const place = trace && at(trace), mark = over(plot, name, look);
      if (place) put(plot, mark, ...place); else mark.hidden = true;
    }
  };
  const slider = document.getElementById("time"), now = document.getElementById("now");
  let asked = 0;
  const point = (t, from) => {
    time = Math.max(0, +t || 0);
    if (slider) {
      slider.value = time;
      now.textContent = `${time.toFixed(2)} s`;
    }
    cancelAnimationFrame(asked);
    asked = requestAnimationFrame(() => {
      for (const plot of plots) if (plot.drawn && plot !== from) marks(plot);
      if (from) marks(from);
    });
    document.documentElement.dataset.time = time;
  };
  if (slider) {
    const play = document.getElementById("play");
    let playing = 0;
    const stop = () => {
      cancelAnimationFrame(playing);
      playing = 0;
      play.textContent = "play";
      play.setAttribute("aria-pressed", "false");
    };
    slider.addEventListener("input", () => { stop(); point(slider.value); });
    which.addEventListener("change", () => point(time));
    play.addEventListener("click", () => {
      if (playing) return stop();
      const start = performance.now() - 1000 * (time >= +slider.max ? 0 : time);
      play.textContent = "pause";
      play.setAttribute("aria-pressed", "true");
      const step = () => {
        const t = (performance.now() - start) / 1000;
        point(Math.min(t, +slider.max));
        if (t >= +slider.max) stop(); else playing = requestAnimationFrame(step);
      };
      playing = requestAnimationFrame(step);
    });
  }

  // Legends: a button hides and shows its curves in all panels of its figure.
  for (const chip of all(".chip")) {
    chip.addEventListener("click", () => {
      const figure = chip.closest(".figure");
      const gone = hidden.get(figure) || hidden.set(figure, new Set()).get(figure);
      const names = [chip.dataset.name, chip.dataset.trial].filter(Boolean);
      const on = chip.getAttribute("aria-pressed") !== "true";
      for (const name of names) if (on) gone.delete(name); else gone.add(name);
      chip.setAttribute("aria-pressed", on);
      for (const plot of all(".plot", figure)) if (plot.drawn) draw(plot);
    });
  }

  // Tables and commands are copied as text.
  const copied = async (text) => {
    try {
      await navigator.clipboard.writeText(text);
    } catch {
      const area = document.createElement("textarea");
      area.value = text;
      document.body.append(area);
      area.select();
      document.execCommand("copy");
      area.remove();
    }
  };
  for (const button of all("button[data-copy]")) {
    button.addEventListener("click", async () => {
      const from = document.getElementById(button.dataset.copy);
      const text = from.rows
        ? [...from.rows].map((row) => [...row.cells].map((cell) => cell.textContent).join("\t")).join("\n")
        : from.textContent;
      await copied(text.replaceAll("\u00a0", " ").replaceAll("\u2060", ""));
      const old = button.textContent;
      button.textContent = "copied";
      setTimeout(() => { button.textContent = old; }, 1200);
    });
  }

  // Print: everything, in light colours, at the width of half a sheet.
  addEventListener("beforeprint", () => {
    light = true;
    folded = all("details").filter((part) => !part.open);
    for (const part of folded) part.open = true;
    for (const plot of plots) {
      draw(plot);
      Plotly.relayout(plot, { autosize: false, width: SHEET, height: plot.clientHeight });
    }
  });
  addEventListener("afterprint", () => {
    light = false;
    for (const part of folded) part.open = false;
    for (const plot of plots) {
      plot.layout.width = plot.layout.height = undefined;
      draw(plot);
    }
  });
  night.addEventListener("change", () => { for (const plot of plots) if (plot.drawn) draw(plot); });

  for (const plot of plots) seen.observe(plot);
  // Draw the others later, one at a time, so that a page that is saved or scrolled is complete.
  const others = [...plots];
  const rest = () => {
    const plot = others.shift();
    if (plot && !plot.drawn && plot.offsetParent) draw(plot);
    if (others.length) setTimeout(rest, 30);
  };
  addEventListener("load", () => setTimeout(rest, 300));
  document.documentElement.dataset.ready = "yes";
})();
