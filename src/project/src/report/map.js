// The map that can be moved: the orthomosaic with plots, plants, gaps, photos and ground points on a canvas.
// Positions are pixels of the orthomosaic, the centre of the top-left one at (0, 0).
(function () {
  "use strict";
  const box = document.getElementById("field-map");
  if (!box) return;
  const data = JSON.parse(document.getElementById("field-map-data").textContent);
  const canvas = box.querySelector("canvas");
  const context = canvas.getContext("2d");
  const hover = box.querySelector(".hover");
  const values = box.querySelector(".values");
  const picker = box.querySelector("select");
  const bar = box.querySelector(".colour-bar");
  const picture = new Image();
  const [width, height] = data.size;
  const view = { u: -0.5, v: -0.5, scale: 1 };
  let trait = picker ? picker.value : "";
  let chosen = null;

  // Viridis in eight steps, told apart by all eyes and in print.
  const ramp = [[68, 1, 84], [70, 50, 127], [54, 92, 141], [39, 127, 142], [31, 161, 135], [74, 194, 109], [159, 218, 58], [253, 231, 37]];
  function colour(share, alpha) {
    const at = Math.min(Math.max(share, 0), 1) * (ramp.length - 1);
    const k = Math.min(Math.floor(at), ramp.length - 2);
    const mixed = ramp[k].map((c, i) => Math.round(c + (at - k) * (ramp[k + 1][i] - c)));
    return "rgba(" + mixed.join(",") + "," + alpha + ")";
  }
  function digits(value) {
    if (value === null || value === undefined) return "-";
    if (Number.isInteger(value)) return String(value);
    return String(Number(value.toPrecision(4)));
  }
  function shown(layer) {
    const control = box.querySelector('input[data-layer="' + layer + '"]');
    return control !== null && control.checked;
  }
  const index = () => data.traits.findIndex((one) => one.name === trait);
  function range() {
    const k = index();
    const known = k < 0 ? [] : data.plots.map((plot) => plot.values[k]).filter((value) => value !== null);
    return known.length ? [Math.min(...known), Math.max(...known)] : null;
  }
  const toScreen = (u, v) => [(u - view.u) * view.scale, (v - view.v) * view.scale];
  const toMap = (x, y) => [view.u + x / view.scale, view.v + y / view.scale];
  function place(u, v) {
    const g = data.georeference;
    if (!g) return "u " + u.toFixed(1) + ", v " + v.toFixed(1) + " px";
    const x = g[0] + g[2] * u + g[4] * v;
    const y = g[1] + g[3] * u + g[5] * v;
    return x.toFixed(2) + ", " + y.toFixed(2);
  }

  function size() {
    const ratio = window.devicePixelRatio || 1;
    canvas.width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    canvas.height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
  }
  function whole() {
    view.scale = Math.min(canvas.clientWidth / width, canvas.clientHeight / height);
    view.u = (width - canvas.clientWidth / view.scale) / 2 - 0.5;
    view.v = (height - canvas.clientHeight / view.scale) / 2 - 0.5;
    draw();
  }
  function zoom(factor, x, y) {
    const [u, v] = toMap(x, y);
    const least = 0.5 * Math.min(canvas.clientWidth / width, canvas.clientHeight / height);
    view.scale = Math.min(Math.max(view.scale * factor, least), 60);
    view.u = u - x / view.scale;
    view.v = v - y / view.scale;
    draw();
  }
  function pan(dx, dy) {
    view.u -= dx / view.scale;
    view.v -= dy / view.scale;
    draw();
  }

  function rings(plot) {
    context.beginPath();
    for (const ring of plot.rings) {
      ring.forEach(([u, v], k) => {
        const [x, y] = toScreen(u, v);
        if (k === 0) context.moveTo(x, y); else context.lineTo(x, y);
      });
      context.closePath();
    }
  }
  function dots(layer, radius, fill) {
    for (let k = 0; k < layer.u.length; k += 1) {
      const [x, y] = toScreen(layer.u[k], layer.v[k]);
      if (x < -9 || y < -9 || x > canvas.clientWidth + 9 || y > canvas.clientHeight + 9) continue;
      context.fillStyle = fill(k);
      if (radius < 2) {
        context.fillRect(x - radius, y - radius, 2 * radius, 2 * radius);
      } else {
        context.beginPath();
        context.arc(x, y, radius, 0, 2 * Math.PI);
        context.fill();
      }
    }
  }
  function marks(layer, symbol, fill) {
    context.font = "12px system-ui, sans-serif";
    context.textBaseline = "middle";
    for (let k = 0; k < layer.u.length; k += 1) {
      const [x, y] = toScreen(layer.u[k], layer.v[k]);
      context.fillStyle = fill(k);
      context.strokeStyle = "#fff";
      context.lineWidth = 1.5;
      context.beginPath();
      if (symbol === "triangle") {
        context.moveTo(x, y - 7);
        context.lineTo(x + 7, y + 5);
        context.lineTo(x - 7, y + 5);
        context.closePath();
      } else {
        context.rect(x - 4, y - 4, 8, 8);
      }
      context.fill();
      context.stroke();
    }
  }
  function draw() {
    context.fillStyle = getComputedStyle(box).getPropertyValue("--wash") || "#eee";
    context.fillRect(0, 0, canvas.clientWidth, canvas.clientHeight);
    const [x, y] = toScreen(-0.5, -0.5);
    context.imageSmoothingEnabled = view.scale * width / (picture.naturalWidth || width) < 3;
    if (picture.complete && picture.naturalWidth) context.drawImage(picture, x, y, width * view.scale, height * view.scale);
    tiles();
    const limits = range();
    if (shown("plots")) {
      const k = index();
      for (const plot of data.plots) {
        rings(plot);
        if (limits && plot.values[k] !== null && data.plots.length > 1) {
          context.fillStyle = colour((plot.values[k] - limits[0]) / Math.max(limits[1] - limits[0], 1e-12), 0.55);
          context.fill("evenodd");
        }
        context.strokeStyle = chosen === plot ? "#ff3b30" : "#ffffff";
        context.lineWidth = chosen === plot ? 3 : 1.5;
        context.stroke();
      }
    }
    const radius = Math.min(Math.max(3.2 * view.scale, 1), 5);
    if (shown("gaps")) dots(data.gaps, Math.max(radius, 2), () => "#4cc9f0");
    if (shown("plants")) dots(data.plants, radius, (k) => (data.plants.confidence[k] < 0.5 ? "#ff9f0a" : "#ff3b30"));
    if (shown("photos")) marks(data.photos, "square", () => "#0072b2");
    if (shown("ground")) marks(data.ground, "triangle", (k) => (data.ground.check[k] ? "#d55e00" : "#2e8b57"));
    scaleBar();
    colourBar(limits);
  }
  // Where a server sends it, the orthomosaic in as many pixels as the screen has.
  const loaded = new Map();
  function tiles() {
    const side = data.tile_px;
    const pictureStep = width / (picture.naturalWidth || width);
    const level = Math.max(0, Math.floor(Math.log2(1 / (view.scale * (window.devicePixelRatio || 1)))));
    const step = 2 ** level;
    if (!side || step >= pictureStep) return;
    const [u, v] = toMap(canvas.clientWidth, canvas.clientHeight);
    const first = (at) => Math.max(0, Math.floor((at + 0.5) / (side * step)));
    const last = (at, length) => Math.min(Math.floor((at + 0.5) / (side * step)), Math.ceil(length / step / side) - 1);
    for (let row = first(view.v); row <= last(v, height); row += 1) {
      for (let column = first(view.u); column <= last(u, width); column += 1) {
        const name = level + "/" + column + "/" + row;
        let tile = loaded.get(name);
        if (!tile) {
          tile = new Image();
          tile.addEventListener("load", draw);
          tile.src = "tiles/" + name + ".jpg";
        }
        // The last one used is the last one dropped.
        loaded.delete(name);
        loaded.set(name, tile);
        if (!tile.complete || !tile.naturalWidth) continue;
        const [x, y] = toScreen(column * side * step - 0.5, row * side * step - 0.5);
        const size = step * view.scale;
        context.imageSmoothingEnabled = size < 3;
        context.drawImage(tile, x, y, tile.naturalWidth * size, tile.naturalHeight * size);
      }
    }
    for (const name of loaded.keys()) {
      if (loaded.size <= 200) break;
      loaded.delete(name);
    }
  }
  function scaleBar() {
    if (!data.gsd_m) return;
    const span = 0.25 * canvas.clientWidth / view.scale * data.gsd_m;
    const unit = Math.pow(10, Math.floor(Math.log10(span)));
    const length = [5, 2, 1].map((k) => k * unit).find((one) => one <= span);
    const px = length / data.gsd_m * view.scale;
    const y = canvas.clientHeight - 14;
    context.fillStyle = "rgba(255,255,255,.8)";
    context.fillRect(8, y - 24, Math.max(px + 12, 60), 34);
    context.fillStyle = "#111";
    context.fillRect(14, y, px, 4);
    context.font = "13px system-ui, sans-serif";
    context.textBaseline = "alphabetic";
    context.fillText(length >= 1 ? digits(length) + " m" : digits(100 * length) + " cm", 14, y - 6);
  }
  function colourBar(limits) {
    if (!bar) return;
    bar.hidden = !(limits && shown("plots") && data.plots.length > 1);
    if (bar.hidden) return;
    const stops = ramp.map((c) => "rgb(" + c.join(",") + ")").join(",");
    bar.querySelector("i").style.background = "linear-gradient(to right," + stops + ")";
    const ends = bar.querySelectorAll("span");
    ends[0].textContent = digits(limits[0]);
    ends[1].textContent = digits(limits[1]);
  }

  function inside(plot, u, v) {
    let odd = false;
    for (const ring of plot.rings) {
      for (let i = 0, j = ring.length - 1; i < ring.length; j = i, i += 1) {
        const [a, b] = [ring[i], ring[j]];
        if ((a[1] > v) !== (b[1] > v) && u < a[0] + (v - a[1]) / (b[1] - a[1]) * (b[0] - a[0])) odd = !odd;
      }
    }
    return odd;
  }
  function nearest(layer, u, v, reach) {
    let best = -1;
    let least = reach * reach;
    for (let k = 0; k < layer.u.length; k += 1) {
      const away = (layer.u[k] - u) ** 2 + (layer.v[k] - v) ** 2;
      if (away < least) { least = away; best = k; }
    }
    return best;
  }
  // What lies under a place of the canvas: its title, and rows of names and values.
  function under(x, y) {
    const [u, v] = toMap(x, y);
    const reach = 8 / view.scale;
    const at = (layer, k) => ["place", place(layer.u[k], layer.v[k]) + (data.crs ? " (" + data.crs + ")" : "")];
    if (shown("ground")) {
      const k = nearest(data.ground, u, v, reach);
      if (k >= 0) {
        const ground = data.ground;
        return { title: (ground.check[k] ? "Check point " : "Control point ") + ground.name[k], rows: [at(ground, k), ["error X, Y, Z", ground.error_cm[k] + " cm"]] };
      }
    }
    if (shown("photos")) {
      const k = nearest(data.photos, u, v, reach);
      if (k >= 0) return { title: "Photo " + data.photos.name[k], rows: [at(data.photos, k)] };
    }
    if (shown("plants")) {
      const plants = data.plants;
      const k = nearest(plants, u, v, reach);
      if (k >= 0) {
        const rows = [at(plants, k), ["confidence", digits(plants.confidence[k])]];
        if (plants.row[k] !== null) rows.push(["row", plants.row[k]]);
        return { title: "Plant " + k, rows, at: [plants.u[k], plants.v[k]] };
      }
    }
    if (shown("gaps")) {
      const k = nearest(data.gaps, u, v, reach);
      if (k >= 0) return { title: "Gap", rows: [at(data.gaps, k), ["plants missing", data.gaps.plants[k]]] };
    }
    if (shown("plots")) {
      const plot = data.plots.find((one) => inside(one, u, v));
      if (plot) {
        const rows = data.traits.map((one, k) => [one.name, digits(plot.values[k]), one.meaning]).filter((row) => row[1] !== "-");
        return { title: "Plot " + plot.name, rows, plot };
      }
    }
    return null;
  }
  function tell(found, u, v) {
    values.replaceChildren();
    const title = document.createElement("h3");
    title.textContent = found ? found.title : place(u, v) + (data.crs ? " (" + data.crs + ")" : "");
    values.append(title);
    if (!found) return;
    const table = document.createElement("table");
    for (const [name, value, meaning] of found.rows) {
      const row = table.insertRow();
      if (meaning) row.title = meaning;
      row.insertCell().textContent = name.replaceAll("_", " ");
      row.insertCell().textContent = value;
    }
    values.append(table);
  }

  // One finger or the mouse moves the map, two fingers zoom it.
  const fingers = new Map();
  let moved = 0;
  const spot = (event) => {
    const edge = canvas.getBoundingClientRect();
    return [event.clientX - edge.left, event.clientY - edge.top];
  };
  canvas.addEventListener("pointerdown", (event) => {
    if (canvas.setPointerCapture && event.isTrusted) canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, spot(event));
    moved = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const now = spot(event);
    const before = fingers.get(event.pointerId);
    if (!before) {
      const found = under(...now);
      hover.hidden = !found;
      if (found) {
        const k = index();
        hover.textContent = found.title + (found.plot && k >= 0 && found.plot.values[k] !== null ? ": " + digits(found.plot.values[k]) : "");
        hover.style.left = Math.min(now[0] + 14, canvas.clientWidth - 120) + "px";
        hover.style.top = now[1] + 14 + "px";
      }
      return;
    }
    moved += Math.abs(now[0] - before[0]) + Math.abs(now[1] - before[1]);
    if (fingers.size === 1) {
      pan(now[0] - before[0], now[1] - before[1]);
    } else if (fingers.size === 2) {
      const other = [...fingers.entries()].find(([id]) => id !== event.pointerId)[1];
      const length = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
      zoom(length(now) / Math.max(length(before), 1), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
    }
    fingers.set(event.pointerId, now);
  });
  function choose(x, y) {
    const found = under(x, y);
    chosen = found && found.plot ? found.plot : null;
    tell(found, ...toMap(x, y));
    const [u, v] = found && found.at ? found.at : toMap(x, y);
    box.dispatchEvent(new CustomEvent("field-click", { detail: { u, v } }));
    draw();
  }
  const lifted = (event) => {
    const was = fingers.delete(event.pointerId);
    if (was && event.type === "pointerup" && moved <= 4) choose(...spot(event));
  };
  // An address that ends in #at=EAST,NORTH opens the map at that place.
  function go() {
    const asked = /^#at=(-?[\d.]+),(-?[\d.]+)$/.exec(location.hash);
    const g = data.georeference;
    if (!asked || !g) return;
    const [x, y] = [Number(asked[1]) - g[0], Number(asked[2]) - g[1]];
    const area = g[2] * g[5] - g[3] * g[4];
    view.scale = Math.max(view.scale, 2);
    view.u = (x * g[5] - y * g[4]) / area - canvas.clientWidth / 2 / view.scale;
    view.v = (y * g[2] - x * g[3]) / area - canvas.clientHeight / 2 / view.scale;
    choose(canvas.clientWidth / 2, canvas.clientHeight / 2);
  }
  window.addEventListener("hashchange", go);
  canvas.addEventListener("pointerup", lifted);
  canvas.addEventListener("pointercancel", lifted);
  canvas.addEventListener("pointerleave", () => { hover.hidden = true; });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(-0.0015 * event.deltaY), ...spot(event));
  }, { passive: false });
  canvas.addEventListener("dblclick", (event) => zoom(2, ...spot(event)));
  canvas.addEventListener("keydown", (event) => {
    const [x, y] = [canvas.clientWidth / 2, canvas.clientHeight / 2];
    const does = {
      "+": () => zoom(1.4, x, y), "=": () => zoom(1.4, x, y), "-": () => zoom(1 / 1.4, x, y), "0": whole,
      ArrowLeft: () => pan(60, 0), ArrowRight: () => pan(-60, 0), ArrowUp: () => pan(0, 60), ArrowDown: () => pan(0, -60),
    }[event.key];
    if (does) { event.preventDefault(); does(); }
  });
  for (const button of box.querySelectorAll("button")) {
    button.addEventListener("click", () => {
      const [x, y] = [canvas.clientWidth / 2, canvas.clientHeight / 2];
      ({ in: () => zoom(1.6, x, y), out: () => zoom(1 / 1.6, x, y), all: whole })[button.dataset.zoom]();
    });
  }
  box.addEventListener("change", () => {
    if (picker) trait = picker.value;
    draw();
  });
  picture.addEventListener("load", draw);
  picture.src = data.picture;
  size();
  whole();
  new ResizeObserver(() => { size(); draw(); }).observe(canvas);
  // When what else the page has to say of a click is there too.
  window.addEventListener("DOMContentLoaded", go);
  // For those who want to drive the map from a script, and for the tests.
  box.fieldMap = { view, zoom, pan, whole, toScreen, data, loaded };
})();
