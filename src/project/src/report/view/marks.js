// Marks of surveyed points: every point in all photos that show it. Places are pixels of a photo, the centre of its first pixel being 0.
(function () {
  "use strict";
  const byId = (id) => document.getElementById(id);
  const COLOURS = { found: "#2bd9a3", hand: "#56b4e9", changed: "#e69f00", expected: "#ffffff" };
  const CROP_PX = 192;
  const LOUPE_PX = 512;
  // What is farther from the other marks of its point is said in red.
  const FAR_PX = 3;
  const [LEAST_ZOOM, MOST_ZOOM] = [0.5, 40];
  let sheet = { revision: "", photos: [], points: [] };
  let [point, chosen] = [0, -1];
  // By "photo/point": where the mark is now, or null where it was removed.
  const changes = new Map();
  const loupe = { canvas: byId("loupe"), u: 0, v: 0, zoom: 8, patch: null };
  let figures = [];

  // Parts of photos.

  const patches = new Map();
  function patch(photo, u, v, side) {
    const [columns, rows] = sheet.photos[photo].size_px;
    const name = "marks/" + photo + ".jpg?u=" + u.toFixed(1) + "&v=" + v.toFixed(1) + "&side=" + side;
    let part = patches.get(name);
    if (!part) {
      const first = (at, length) => Math.round(Math.min(Math.max(Number(at.toFixed(1)) - side / 2, 0), length));
      part = { photo, left: first(u, columns), top: first(v, rows), picture: new Image(), isThere: false };
      part.whenThere = new Promise((resolve) => {
        part.picture.addEventListener("load", () => { part.isThere = true; resolve(); });
        part.picture.addEventListener("error", resolve);
      });
      part.picture.src = name;
      if (patches.size > 400) patches.delete(patches.keys().next().value);
      patches.set(name, part);
    }
    return part;
  }

  // What is known of a sight.

  const sights = () => (sheet.points[point] || { sights: [] }).sights;
  const key = (sight, of) => sight.photo + "/" + of;
  const isChanged = (sight, of) => changes.has(key(sight, of));
  function mark(sight, of) {
    return isChanged(sight, of) ? changes.get(key(sight, of)) : sight.mark && sight.mark.image_px;
  }
  const home = (sight) => sight.mark ? sight.mark.image_px : sight.expected_px;
  const centre = (sight) => mark(sight, point) || home(sight);
  const pxPerM = (sight) => sight.px_per_m || 50;
  const colour = (sight) =>
    isChanged(sight, point) ? COLOURS.changed : sight.mark && sight.mark.is_found ? COLOURS.found : COLOURS.hand;

  function said(sight) {
    const was = sight.mark;
    if (isChanged(sight, point)) return !mark(sight, point) ? "removed, not saved" : (was ? "moved" : "new") + ", not saved";
    if (!was) return "no mark";
    let text = was.is_found ? "found" : "by hand";
    if (was.sigma_px !== null) text += ", ± " + was.sigma_px.toFixed(2) + " px";
    return text;
  }
  const residual = (sight) => isChanged(sight, point) || !sight.mark ? null : sight.mark.residual_px;

  // Drawing.

  function draw(canvas, side, u, v, zoom, part, sight) {
    const ratio = window.devicePixelRatio || 1;
    canvas.width = canvas.height = Math.round(side * ratio);
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    const x = (at) => side / 2 + (at - u) * zoom;
    const y = (at) => side / 2 + (at - v) * zoom;
    if (part && part.isThere) {
      context.imageSmoothingEnabled = zoom < 1;
      const { picture, left, top } = part;
      context.drawImage(picture, x(left - 0.5), y(top - 0.5), picture.naturalWidth * zoom, picture.naturalHeight * zoom);
    }
    const stroke = (style, dash, path) => {
      for (const [line, width] of [["rgba(0, 0, 0, .65)", 3.5], [style, 1.75]]) {
        context.beginPath();
        path();
        [context.strokeStyle, context.lineWidth] = [line, width];
        context.setLineDash(dash);
        context.stroke();
      }
    };
    const at = mark(sight, point);
    if (sight.expected_px && !at) {
      stroke(COLOURS.expected, [4, 4], () => context.arc(x(sight.expected_px[0]), y(sight.expected_px[1]), 14, 0, 7));
    }
    if (!at) return;
    // Four strokes that leave the middle open.
    const length = side / 12;
    stroke(colour(sight), [], () => {
      for (const [i, j] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        context.moveTo(x(at[0]) + 5 * i, y(at[1]) + 5 * j);
        context.lineTo(x(at[0]) + length * i, y(at[1]) + length * j);
      }
    });
  }

  const shownM = () => Math.pow(2, Number(byId("shown").value)) / 2;

  const sidePx = (sight) => Math.min(Math.max(Math.ceil(shownM() * pxPerM(sight)), 16), 1500);

  function drawCrop(figure, sight) {
    const canvas = figure.querySelector("canvas");
    const [u, v] = home(sight);
    const side = sidePx(sight);
    const part = patch(sight.photo, u, v, side + 2);
    const show = () => { if (figure.isConnected) draw(canvas, CROP_PX, u, v, CROP_PX / side, part, sight); };
    show();
    if (!part.isThere) part.whenThere.then(show);
    const off = residual(sight);
    const [name, state] = figure.querySelectorAll("figcaption > *");
    name.textContent = sheet.photos[sight.photo].name;
    state.textContent = said(sight) + (off === null ? "" : ", " + off.toFixed(2) + " px off the others");
    state.className = off !== null && off > FAR_PX ? "far" : "";
    figure.setAttribute("aria-selected", sights()[chosen] === sight);
  }

  function drawLoupe() {
    const sight = sights()[chosen];
    const side = loupe.canvas.clientWidth || 400;
    if (!sight) {
      byId("place").textContent = sights().length ? "Choose a photo." : "No photo shows this point.";
      loupe.canvas.getContext("2d").clearRect(0, 0, loupe.canvas.width, loupe.canvas.height);
      return;
    }
    const reach = side / 2 / loupe.zoom;
    const part = loupe.patch;
    const isWithin = part && part.photo === sight.photo &&
      Math.abs(loupe.u - part.u) + reach < part.side / 2 && Math.abs(loupe.v - part.v) + reach < part.side / 2;
    if (!isWithin) {
      const wanted = Math.min(Math.max(LOUPE_PX, Math.ceil(3 * reach)), 2048);
      const fresh = patch(sight.photo, loupe.u, loupe.v, wanted);
      [fresh.u, fresh.v, fresh.side] = [loupe.u, loupe.v, wanted];
      loupe.patch = fresh;
      if (!fresh.isThere) fresh.whenThere.then(() => { if (loupe.patch === fresh) drawLoupe(); });
    }
    draw(loupe.canvas, side, loupe.u, loupe.v, loupe.zoom, loupe.patch, sight);
    [loupe.canvas.dataset.u, loupe.canvas.dataset.v, loupe.canvas.dataset.zoom] = [loupe.u, loupe.v, loupe.zoom];
    const at = mark(sight, point);
    byId("place").textContent = sheet.points[point].label + " in " + sheet.photos[sight.photo].name + ": " +
      (at ? "column " + at[0].toFixed(2) + ", row " + at[1].toFixed(2) + ", " : "") + said(sight);
  }

  function drawPoints() {
    byId("points").replaceChildren(...sheet.points.map((of, number) => {
      const marked = of.sights.filter((sight) => mark(sight, number)).length;
      const offs = of.sights.filter((sight) => sight.mark && sight.mark.residual_px !== null && !isChanged(sight, number))
        .map((sight) => sight.mark.residual_px);
      const worst = Math.max(...offs);
      const button = document.createElement("button");
      button.type = "button";
      button.dataset.point = number;
      button.setAttribute("aria-current", number === point);
      const part = (name, text, className) => {
        const element = document.createElement(name);
        [element.textContent, element.className] = [text, className || ""];
        button.append(element);
      };
      part("span", "", "dot" + (marked > 1 ? (worst > FAR_PX ? " red" : " green") : marked ? " yellow" : ""));
      part("b", of.label);
      part("span", marked + " of " + of.sights.length, "count");
      part("small", of.role + (offs.length ? ", at most " + worst.toFixed(2) + " px off" : ""));
      button.addEventListener("click", () => goTo(number));
      const item = document.createElement("li");
      item.append(button);
      return item;
    }));
  }

  function drawState() {
    const saved = sheet.points.reduce((sum, of) => sum + of.sights.filter((sight) => sight.mark).length, 0);
    const state = byId("state");
    state.className = changes.size ? "unsaved" : "";
    state.textContent = saved + (saved === 1 ? " mark saved" : " marks saved") +
      (changes.size ? ", " + changes.size + (changes.size === 1 ? " change" : " changes") + " not saved" : "");
    byId("save").disabled = byId("discard").disabled = !changes.size;
  }

  function drawCrops() {
    figures = sights().map((sight, number) => {
      const figure = document.createElement("figure");
      figure.dataset.photo = sight.photo;
      const caption = document.createElement("figcaption");
      caption.append(document.createElement("b"), document.createElement("span"));
      figure.append(document.createElement("canvas"), caption);
      figure.addEventListener("click", (event) => {
        const sight = sights()[number];
        choose(number);
        // Where there is no mark yet, the loupe goes where the target was seen.
        const box = figure.querySelector("canvas").getBoundingClientRect();
        const at = [event.clientX - box.left, event.clientY - box.top].map((px) => px / box.width - 0.5);
        if (mark(sight, point) || at.some((share) => Math.abs(share) > 0.5)) return;
        const side = sidePx(sight);
        [loupe.u, loupe.v] = home(sight).map((value, axis) => value + side * at[axis]);
        drawLoupe();
      });
      return figure;
    });
    byId("crops").replaceChildren(...figures);
    byId("point-name").textContent = sheet.points[point] ? sheet.points[point].label : "";
    byId("shown-m").textContent = shownM().toFixed(1) + " m";
    figures.forEach((figure, number) => drawCrop(figure, sights()[number]));
  }

  function drawAll() {
    drawPoints();
    drawCrops();
    drawLoupe();
    drawState();
  }

  // What a person does.

  function choose(number) {
    const before = chosen;
    chosen = number;
    const sight = sights()[chosen];
    if (sight) {
      [loupe.u, loupe.v] = centre(sight);
      if (before === -1) loupe.zoom = Math.min(Math.max(2 * loupe.canvas.clientWidth / sidePx(sight), 1), 16);
    }
    [before, chosen].filter((k) => figures[k]).forEach((k) => drawCrop(figures[k], sights()[k]));
    if (figures[chosen]) figures[chosen].scrollIntoView({ block: "nearest" });
    drawLoupe();
  }

  function goTo(number) {
    [point, chosen] = [number, -1];
    drawPoints();
    drawCrops();
    const first = sights().findIndex((sight) => !mark(sight, point));
    choose(sights().length ? Math.max(first, 0) : -1);
  }

  function put(at) {
    const sight = sights()[chosen];
    if (!sight) return;
    if (at) {
      const size = sheet.photos[sight.photo].size_px;
      at = at.map((value, axis) => Math.round(1000 * Math.min(Math.max(value, -0.5), size[axis] - 0.5)) / 1000);
    }
    if (!at && !sight.mark) changes.delete(key(sight, point));
    else changes.set(key(sight, point), at);
    drawPoints();
    drawCrop(figures[chosen], sight);
    drawLoupe();
    drawState();
  }

  function fail(message) {
    [byId("state").className, byId("state").textContent] = ["failed", message];
  }

  async function take(answer) {
    if (!answer.ok) return fail(await answer.text());
    const before = sights()[chosen];
    sheet = await answer.json();
    changes.clear();
    drawAll();
    const again = before ? sights().findIndex((sight) => sight.photo === before.photo) : -1;
    if (again >= 0) choose(again);
    else if (sheet.points.length) goTo(point);
  }

  async function load() {
    await take(await fetch("marks.json"));
  }

  async function start() {
    const answer = await fetch("marks.json");
    // Without any mark a block may be metres off.
    if (answer.ok && !(await answer.clone().json()).points.some((of) => of.sights.some((sight) => sight.mark))) byId("shown").value = 3.5;
    await take(answer);
  }

  async function save() {
    if (!changes.size) return;
    const list = [...changes].map(([name, image_px]) => {
      const [photo, of] = name.split("/").map(Number);
      return { photo, point: of, image_px };
    });
    byId("save").disabled = true;
    const body = JSON.stringify({ revision: sheet.revision, changes: list });
    try {
      await take(await fetch("marks.json", { method: "PUT", headers: { "Content-Type": "application/json" }, body }));
    } catch (error) {
      fail("not saved: the program that shows this page does not answer (" + error.message + ")");
    }
    byId("save").disabled = !changes.size;
  }

  let pressed = null;
  const placeAt = (event) => {
    const box = loupe.canvas.getBoundingClientRect();
    return [loupe.u + (event.clientX - box.left - box.width / 2) / loupe.zoom,
      loupe.v + (event.clientY - box.top - box.height / 2) / loupe.zoom];
  };
  loupe.canvas.addEventListener("pointerdown", (event) => {
    loupe.canvas.setPointerCapture(event.pointerId);
    pressed = { x: event.clientX, y: event.clientY, u: loupe.u, v: loupe.v, isDrag: false };
  });
  loupe.canvas.addEventListener("pointermove", (event) => {
    if (!pressed) return;
    const moved = [event.clientX - pressed.x, event.clientY - pressed.y];
    pressed.isDrag = pressed.isDrag || Math.hypot(...moved) > 4;
    if (!pressed.isDrag) return;
    [loupe.u, loupe.v] = [pressed.u - moved[0] / loupe.zoom, pressed.v - moved[1] / loupe.zoom];
    drawLoupe();
  });
  loupe.canvas.addEventListener("pointerup", (event) => {
    if (pressed && !pressed.isDrag) put(placeAt(event));
    pressed = null;
  });
  loupe.canvas.addEventListener("pointercancel", () => { pressed = null; });
  loupe.canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const [u, v] = placeAt(event);
    const zoom = Math.min(Math.max(loupe.zoom * Math.pow(1.0015, -event.deltaY), LEAST_ZOOM), MOST_ZOOM);
    // What is below the pointer stays there.
    [loupe.u, loupe.v] = [u + (loupe.u - u) * loupe.zoom / zoom, v + (loupe.v - v) * loupe.zoom / zoom];
    loupe.zoom = zoom;
    drawLoupe();
  }, { passive: false });

  const STEPS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  document.addEventListener("keydown", (event) => {
    if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "s") {
      event.preventDefault();
      save();
      return;
    }
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "INPUT") return;
    const sight = sights()[chosen];
    const letter = event.key.toLowerCase();
    if (STEPS[event.key] && sight && centre(sight)) {
      event.preventDefault();
      const step = event.shiftKey ? 1 : 0.1;
      put(centre(sight).map((value, axis) => value + step * STEPS[event.key][axis]));
    } else if ((event.key === "Delete" || event.key === "Backspace") && sight) {
      event.preventDefault();
      put(null);
    } else if ((letter === "n" || letter === "p") && figures.length) {
      choose((chosen + (letter === "n" ? 1 : figures.length - 1)) % figures.length);
    }
  });
  byId("shown").addEventListener("input", drawCrops);
  byId("save").addEventListener("click", save);
  byId("discard").addEventListener("click", load);
  window.addEventListener("resize", drawLoupe);
  window.addEventListener("beforeunload", (event) => { if (changes.size) event.preventDefault(); });
  start().catch((error) => fail(error.message));
})();
