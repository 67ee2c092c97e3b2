// The report's interactions: the cell in three dimensions on a 2-D canvas, contents that follow
// the reader, print that opens every detail. Without this script the report is whole but still.
"use strict";
(() => {
  const root = document.documentElement;
  root.classList.add("js");
  const data = JSON.parse(document.getElementById("report-data").textContent);

  const stage = document.querySelector(".viewer");
  if (stage) cellViewer(stage, data.scene);
  followReader();
  stopAtScrollable();
  openForPrint();
  copyPlainMinus();
  offerData();

  function cellViewer(box, scene) {
    const EYE_DISTANCE = 4.5, FILLING = 0.9, NEAR = 0.9; // as in scene.py
    const canvas = box.querySelector("canvas"), tip = box.querySelector(".tip");
    const pen = canvas.getContext("2d");
    const R = scene.radius, D = EYE_DISTANCE * R, rad = Math.PI / 180;
    const home = { az: scene.view.azimuth_deg, el: scene.view.elevation_deg };
    const view = { ...home, zoom: 1, x: 0, y: 0 };
    const words = {
      base: () => "robot base", hand: n => `hand, spot ${n}`, camera: n => `camera ${n}`,
      laser: n => `beam of laser ${n}`, plane: n => `plane ${n}`, spot: n => `spots on plane ${n}`,
      rejected: n => `rejected spots on plane ${n}`, ellipsoid: n => `uncertainty, ${n}`,
    };
    let held = false; // somebody has moved the scene: a new size of the window leaves it alone
    const visible = new Set(scene.layers.filter(l => l.visible).map(l => l.name));
    let width = 0, height = 0, fitted = 1, colours = {}, drawn = [], waiting = false;

    function readColours() {
      const style = getComputedStyle(root), get = name => style.getPropertyValue(name).trim();
      colours = {
        paper: get("--paper"), ink: get("--ink"), base: get("--soft"), hand: get("--soft"),
        camera: get("--part-0"), laser: get("--scene-laser"), plane: get("--part-2"),
        spot: get("--part-4"), rejected: get("--bad"), ellipsoid: get("--scene-ellipsoid"),
        x: get("--axis-x"), y: get("--axis-y"), z: get("--axis-z"),
        font: getComputedStyle(document.body).fontFamily,
      };
    }

    // the screen's axes in the base and the scale: the same projection as in scene.py
    function projector() {
      const a = view.az * rad, e = view.el * rad;
      const sa = Math.sin(a), ca = Math.cos(a), se = Math.sin(e), ce = Math.cos(e);
      const [cx, cy, cz] = scene.centre;
      const size = view.zoom;
      return ([px, py, pz]) => {
        const x = px - cx, y = py - cy, z = pz - cz;
        const depth = ce * ca * x + ce * sa * y + se * z;
        const k = size * D / Math.max(D - depth, (1 - NEAR) * D);
        return [
          width / 2 + view.x + k * (-sa * x + ca * y),
          height / 2 + view.y - k * (-se * ca * x - se * sa * y + ce * z),
          depth,
        ];
      };
    }

    // zoom and shift with which what is visible at first lies in the middle and fills the figure
    function fit() {
      Object.assign(view, { zoom: 1, x: 0, y: 0 });
      const at = projector();
      let left = Infinity, right = -Infinity, top = Infinity, bottom = -Infinity;
      for (const part of scene.primitives) {
        if (!visible.has(part.layer)) continue;
        const points = part.points.map(at);
        if (points.some(p => p[2] > NEAR * D)) continue;
        for (const [x, y] of points) {
          left = Math.min(left, x); right = Math.max(right, x);
          top = Math.min(top, y); bottom = Math.max(bottom, y);
        }
      }
      if (right < left) return;
      view.zoom = FILLING * Math.min(width / Math.max(right - left, 1e-9),
        height / Math.max(bottom - top, 1e-9));
      view.x = view.zoom * (width / 2 - (left + right) / 2);
      view.y = view.zoom * (height / 2 - (top + bottom) / 2);
      fitted = view.zoom;
    }

    function draw() {
      waiting = false;
      const at = projector(), labels = [];
      drawn = [];
      for (const part of scene.primitives) {
        if (!visible.has(part.layer) || !part.points.length) continue;
        const points = part.points.map(at);
        if (points.some(p => p[2] > NEAR * D)) continue;
        const depth = points.reduce((sum, p) => sum + p[2], 0) / points.length;
        if (part.kind === "label") labels.push({ part, points, depth });
        else drawn.push({ part, points, depth, face: part.kind === "polygon" && part.role === "plane" });
      }
      drawn.sort((a, b) => (b.face - a.face) || (a.depth - b.depth));
      pen.clearRect(0, 0, width, height);
      pen.lineJoin = pen.lineCap = "round";
      for (const shape of drawn) paint(shape);
      label(labels.sort((a, b) => b.depth - a.depth));
    }

    function paint({ part, points, face }) {
      const colour = colours[part.axis || part.role] || colours.ink;
      pen.strokeStyle = pen.fillStyle = colour;
      pen.globalAlpha = 1;
      pen.beginPath();
      if (part.kind === "points") {
        for (const [x, y] of points) { pen.moveTo(x + 2.2, y); pen.arc(x, y, 2.2, 0, 7); }
        pen.fill();
        return;
      }
      points.forEach(([x, y], i) => (i ? pen.lineTo(x, y) : pen.moveTo(x, y)));
      if (part.closed || part.kind === "polygon") pen.closePath();
      if (face) { pen.globalAlpha = 0.12; pen.fill(); pen.globalAlpha = 1; }
      if (part.kind === "line" && part.role === "laser" && !part.axis) pen.globalAlpha = 0.45;
      pen.lineWidth = part.axis ? 2 : 1.1;
      pen.stroke();
      pen.globalAlpha = 1;
    }

    function label(items) {
      const taken = [];
      pen.font = `12px ${colours.font}`;
      for (const { part, points: [[x, y]] } of items) {
        const w = pen.measureText(part.text).width;
        const left = Math.min(x + 4, width - w - 4);
        const b = [left - 4, y - 16, left + w + 2, y + 4];
        if (taken.some(t => b[0] < t[2] && t[0] < b[2] && b[1] < t[3] && t[1] < b[3])) continue;
        taken.push(b);
        pen.lineWidth = 3.5;
        pen.strokeStyle = colours.paper;
        pen.fillStyle = colours.ink;
        pen.strokeText(part.text, left, y - 4);
        pen.fillText(part.text, left, y - 4);
      }
    }

    function redraw() {
      if (!waiting) { waiting = true; requestAnimationFrame(draw); }
    }

    function resize() {
      const ratio = window.devicePixelRatio || 1;
      width = canvas.clientWidth;
      height = canvas.clientHeight;
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
      pen.setTransform(ratio, 0, 0, ratio, 0, 0);
      if (!held) fit();
      redraw();
    }

    function turn(dAz, dEl) {
      held = true;
      view.az += dAz;
      view.el = Math.max(-90, Math.min(90, view.el + dEl));
      redraw();
    }
    function pan(dx, dy) { held = true; view.x += dx; view.y += dy; redraw(); }
    function zoom(factor, x = width / 2, y = height / 2) {
      const next = Math.max(0.2 * fitted, Math.min(40 * fitted, view.zoom * factor)), f = next / view.zoom;
      view.x = (view.x + width / 2 - x) * f + x - width / 2;
      view.y = (view.y + height / 2 - y) * f + y - height / 2;
      view.zoom = next;
      held = true;
      redraw();
    }
    function lookFrom(from) { Object.assign(view, from); held = false; fit(); redraw(); }
    const looks = {
      home: () => lookFrom(home),
      front: () => lookFrom({ az: 0, el: 0 }),
      side: () => lookFrom({ az: -90, el: 0 }),
      top: () => lookFrom({ az: -90, el: 90 }),
      in: () => zoom(1.25),
      out: () => zoom(0.8),
    };
    
    // one pointer turns (or shifts, with Shift or another button), two shift and zoom
    const down = new Map();
    canvas.addEventListener("pointerdown", event => {
      if (event.pointerType === "touch" && document.activeElement !== canvas) return;
      canvas.focus({ preventScroll: true });
      canvas.setPointerCapture(event.pointerId);
      down.set(event.pointerId, [event.clientX, event.clientY]);
      canvas.classList.add("turning");
    });
    canvas.addEventListener("pointermove", event => {
      const before = down.get(event.pointerId);
      if (!before) { hover(event); return; }
      const now = [event.clientX, event.clientY];
      const dx = now[0] - before[0], dy = now[1] - before[1];
      if (down.size === 2) {
        const other = [...down].find(([id]) => id !== event.pointerId)[1];
        const box = canvas.getBoundingClientRect();
        const apart = p => Math.hypot(p[0] - other[0], p[1] - other[1]) || 1;
        pan(dx / 2, dy / 2);
        zoom(apart(now) / apart(before), (now[0] + other[0]) / 2 - box.left,
          (now[1] + other[1]) / 2 - box.top);
      } else if (event.shiftKey || event.buttons > 1) {
        pan(dx, dy);
      } else {
        turn(-dx * 0.4, dy * 0.4);
      }
      down.set(event.pointerId, now);
      tip.style.display = "none";
    });
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, event => {
        down.delete(event.pointerId);
        if (!down.size) canvas.classList.remove("turning");
      });
    }
    canvas.addEventListener("pointerleave", () => { tip.style.display = "none"; });
    canvas.addEventListener("contextmenu", event => event.preventDefault());
    // the page scrolls under the wheel until somebody has chosen the figure
    canvas.addEventListener("wheel", event => {
      if (document.activeElement !== canvas) return;
      event.preventDefault();
      zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), event.offsetX, event.offsetY);
    }, { passive: false });
    canvas.addEventListener("keydown", event => {
      const move = {
        ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1],
      }[event.key];
      const named = {
        "+": "in", "=": "in", "-": "out", "0": "home", Home: "home", 1: "front", 2: "side", 3: "top",
      }[event.key];
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key === "Escape") canvas.blur();
      else if (move && event.shiftKey) pan(20 * move[0], 20 * move[1]);
      else if (move) turn(-5 * move[0], -5 * move[1]);
      else if (named) looks[named]();
      else return;
      event.preventDefault();
    });

    // the name of what is nearest to the pointer; what is in front wins a tie
    function hover(event) {
      let best = 9, name = "";
      for (let i = drawn.length - 1; i >= 0; i--) {
        const { part, points, face } = drawn[i];
        if (!part.name || face) continue;
        const away = distance(event.offsetX, event.offsetY, points, part);
        if (away < best) { best = away; name = words[part.role](part.name); }
      }
      if (!name) {
        const under = drawn.filter(s => s.face && inside(event.offsetX, event.offsetY, s.points));
        if (under.length) name = words.plane(under[under.length - 1].part.name);
      }
      tip.textContent = name;
      tip.style.display = name ? "block" : "none";
      const left = Math.min(event.offsetX + 12, width - tip.offsetWidth - 6);
      tip.style.left = `${Math.max(left, 4)}px`;
      tip.style.top = `${event.offsetY + 14}px`;
    }
    function distance(x, y, points, part) {
      if (part.kind === "points") {
        return Math.min(...points.map(p => Math.hypot(p[0] - x, p[1] - y)));
      }
      const around = part.closed || part.kind === "polygon";
      let best = Infinity;
      for (let i = around ? 0 : 1; i < points.length; i++) {
        const [ax, ay] = points[(i || points.length) - 1], [bx, by] = points[i];
        const l2 = (bx - ax) ** 2 + (by - ay) ** 2;
        const t = l2 ? Math.max(0, Math.min(1, ((x - ax) * (bx - ax) + (y - ay) * (by - ay)) / l2)) : 0;
        best = Math.min(best, Math.hypot(ax + t * (bx - ax) - x, ay + t * (by - ay) - y));
      }
      return best;
    }
    function inside(x, y, points) {
      let odd = false;
      for (let i = 0, j = points.length - 1; i < points.length; j = i++) {
        const [ax, ay] = points[i], [bx, by] = points[j];
        if ((ay > y) !== (by > y) && x < (bx - ax) * (y - ay) / (by - ay) + ax) odd = !odd;
      }
      return odd;
    }

    for (const tick of box.querySelectorAll("input[data-layer]")) {
      const apply = () => {
        visible[tick.checked ? "add" : "delete"](tick.dataset.layer);
        redraw();
      };
      tick.addEventListener("change", apply);
      apply(); // a browser may remember ticks over a reload
    }
    for (const button of box.querySelectorAll("button[data-look]")) {
      button.addEventListener("click", () => looks[button.dataset.look]());
    }
    const recolour = () => { readColours(); redraw(); };
    window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolour);
    new ResizeObserver(resize).observe(canvas);
    readColours();
    resize();
  }

  function followReader() {
    const links = new Map();
    for (const link of document.querySelectorAll(".contents a")) links.set(link.hash.slice(1), link);
    const seen = new Set();
    const watch = new IntersectionObserver(entries => {
      for (const e of entries) seen[e.isIntersecting ? "add" : "delete"](e.target.id);
      const current = [...links.keys()].find(id => seen.has(id));
      for (const [id, link] of links) {
        if (id === current) link.setAttribute("aria-current", "true");
        else link.removeAttribute("aria-current");
      }
    }, { rootMargin: "0px 0px -60% 0px" });
    for (const id of links.keys()) watch.observe(document.getElementById(id));
  }

  // the keyboard stops at a table only where there is something to scroll
  function stopAtScrollable() {
    const watch = new ResizeObserver(entries => {
      for (const { target } of entries) {
        if (target.scrollWidth > target.clientWidth) target.tabIndex = 0;
        else target.removeAttribute("tabindex");
      }
    });
    for (const part of document.querySelectorAll(".scroll, pre")) watch.observe(part);
  }

  // for browsers that cannot open details by style alone
  function openForPrint() {
    let opened = [];
    window.addEventListener("beforeprint", () => {
      opened = [...document.querySelectorAll("details:not([open])")];
      for (const part of opened) part.open = true;
    });
    window.addEventListener("afterprint", () => {
      for (const part of opened) part.open = false;
    });
  }

  // the tables print a true minus sign; what is copied must be a number to a program
  function copyPlainMinus() {
    document.addEventListener("copy", event => {
      const chosen = document.getSelection();
      if (!chosen.rangeCount || !String(chosen).includes("\u2212")) return;
      const holder = document.createElement("div");
      holder.append(chosen.getRangeAt(0).cloneContents());
      event.clipboardData.setData("text/plain", String(chosen).replaceAll("\u2212", "-"));
      event.clipboardData.setData("text/html", holder.innerHTML.replaceAll("\u2212", "-"));
      event.preventDefault();
    });
  }

  function offerData() {
    const link = document.getElementById("save-data");
    if (!link) return;
    const text = JSON.stringify(data, null, 1);
    link.href = URL.createObjectURL(new Blob([text], { type: "application/json" }));
  }
})();
