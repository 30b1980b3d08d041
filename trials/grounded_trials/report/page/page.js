"use strict";
(() => {
  const tip = document.getElementById("tip");
  const lines = new WeakMap();

  const move = (event) => {
    const w = tip.offsetWidth, h = tip.offsetHeight;
    const x = Math.min(event.clientX + 14, innerWidth - w - 6);
    const y = event.clientY + h + 24 > innerHeight ? event.clientY - h - 12 : event.clientY + 16;
    tip.style.left = Math.max(4, x) + "px";
    tip.style.top = Math.max(4, y) + "px";
  };

  const show = (event, rows) => {
    tip.replaceChildren(...rows.map(([role, text]) => {
      const row = document.createElement("div");
      if (role) {
        const dot = document.createElement("i");
        dot.className = role;
        row.append(dot);
      }
      row.append(text);
      return row;
    }));
    tip.style.display = rows.length ? "block" : "none";
    move(event);
  };

  // The points of a path: absolute start, relative steps, in tenths of a pixel.
  const points = (path) => {
    if (!lines.has(path)) {
      const n = (path.getAttribute("d").replace("h1", "").match(/-?\d+/g) || []).map(Number);
      for (let i = 2; i < n.length; i++) n[i] += n[i - 2];
      let t = 0;
      const times = (path.dataset.t || "").split(" ").filter(Boolean).map((d) => (t += +d) / 100);
      lines.set(path, { n, times });
    }
    return lines.get(path);
  };

  const written = (value, resolution) =>
    value.toFixed(Math.min(6, Math.max(0, Math.ceil(-Math.log10(resolution || 1)))));

  const heightAt = (n, x) => {
    if (n.length < 2 || x < n[0] - 6 || x > n[n.length - 2] + 6) return null;
    let i = 0;
    while (i + 2 < n.length && n[i + 2] < x) i += 2;
    if (i + 2 >= n.length || n[i + 2] === n[i]) return n[i + 1];
    const part = Math.min(1, Math.max(0, (x - n[i]) / (n[i + 2] - n[i])));
    return n[i + 1] + part * (n[i + 3] - n[i + 1]);
  };

  const hover = (svg, event) => {
    const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    const [left, top, width, height] = svg.dataset.box.split(" ").map(Number);
    const [x0, x1, y0, y1] = svg.dataset.axes.split(" ").map(Number);
    const names = svg.dataset.names.split("|");
    if (at.x < left || at.x > left + width || at.y < top || at.y > top + height) return leave(svg);
    const xOf = (x) => x0 + (x - left) / width * (x1 - x0);
    const yOf = (y) => y1 - (y - top) / height * (y1 - y0);
    const fx = (x) => written(xOf(x), (x1 - x0) / width);
    const fy = (y) => written(yOf(y), (y1 - y0) / height);
    const paths = [...svg.querySelectorAll("path[data-name]")];
    let rows = [], mark = "";
    if (svg.dataset.kind === "path") {
      let best = 400 * 400;
      for (const path of paths) {
        const { n, times } = points(path);
        for (let i = 0; i < n.length; i += 2) {
          const d = (n[i] - at.x) ** 2 + (n[i + 1] - at.y) ** 2;
          if (d >= best) continue;
          best = d;
          mark = `M${n[i] - 60} ${n[i + 1]}h120m-60-60v120`;
          const when = times.length ? [["", `${times[i / 2].toFixed(2)} s`]] : [];
          rows = [[path.classList[0], path.dataset.name], ...when,
            ["", `${names[0]}: ${fx(n[i])}`], ["", `${names[1]}: ${fy(n[i + 1])}`]];
        }
      }
    } else if (svg.dataset.kind === "time") {
      mark = `M${at.x} ${top}v${height}`;
      for (const path of paths) {
        const y = heightAt(points(path).n, at.x);
        if (y !== null) rows.push([path.classList[0], `${fy(y)}  ${path.dataset.name}`]);
      }
      if (rows.length) rows.unshift(["", `${names[0]}: ${fx(at.x)}`]);
    }
    cross(svg, rows.length ? mark : "");
    show(event, rows);
  };

  const cross = (svg, mark) => {
    let line = svg.querySelector("path.cross");
    if (!line) {
      line = document.createElementNS("http://www.w3.org/2000/svg", "path");
      line.setAttribute("class", "cross");
      svg.append(line);
    }
    line.setAttribute("d", mark);
  };

  const leave = (svg) => {
    tip.style.display = "none";
    if (svg.classList.contains("plot")) cross(svg, "");
  };

  const pointed = (event) => {
    const svg = event.currentTarget, noted = event.target.closest("[data-note]");
    if (noted) return show(event, noted.dataset.note.split("\n").map((text) => ["", text]));
    if (svg.classList.contains("plot")) return hover(svg, event);
    leave(svg);
  };

  for (const svg of document.querySelectorAll(".panels svg")) {
    svg.addEventListener("pointermove", pointed);
    svg.addEventListener("pointerdown", pointed);
    svg.addEventListener("pointerleave", () => leave(svg));
    svg.addEventListener("focusin", (event) => {
      const box = event.target.getBoundingClientRect();
      const note = event.target.dataset.note || "";
      show({ clientX: box.right, clientY: box.bottom }, note.split("\n").map((text) => ["", text]));
    });
    svg.addEventListener("focusout", () => leave(svg));
  }

  const put = async (text) => {
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

  for (const button of document.querySelectorAll("button[data-copy]")) {
    button.addEventListener("click", async () => {
      const from = document.getElementById(button.dataset.copy);
      const text = from.rows
        ? [...from.rows].map((row) => [...row.cells].map((cell) => cell.textContent).join("\t")).join("\n")
        : from.textContent;
      await put(text);
      const old = button.textContent;
      button.textContent = "copied";
      setTimeout(() => { button.textContent = old; }, 1200);
    });
  }
  addEventListener("beforeprint", () => {
    for (const part of document.querySelectorAll("details")) part.open = true;
  });
  document.documentElement.dataset.ready = "yes";
})();
