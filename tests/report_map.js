// Drives the map of a report as a person would, and leaves what was seen in an attribute of the body.
window.addEventListener("load", () => setTimeout(() => {
  const seen = {};
  try {
    const box = document.getElementById("field-map");
    const { view, data, toScreen, whole } = box.fieldMap;
    const canvas = box.querySelector("canvas");
    const values = () => box.querySelector(".values").textContent;
    const fire = (type, x, y, more) => {
      const edge = canvas.getBoundingClientRect();
      const at = { clientX: edge.left + x, clientY: edge.top + y, bubbles: true, cancelable: true, pointerId: 1, ...more };
      canvas.dispatchEvent(type === "wheel" ? new WheelEvent(type, at) : new PointerEvent(type, at));
    };
    const click = (u, v) => {
      const [x, y] = toScreen(u, v);
      fire("pointerdown", x, y);
      fire("pointerup", x, y);
    };
    const ink = () => {
      const pixels = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
      return new Set(Array.from({ length: 4000 }, (_, k) => pixels[4 * ((k * 97) % (pixels.length / 4))])).size;
    };
    seen.colours = ink();
    const start = { ...view };
    fire("wheel", 200, 150, { deltaY: -400 });
    seen.zoomed = view.scale / start.scale;
    const before = view.u;
    fire("pointerdown", 200, 100);
    fire("pointermove", 150, 100);
    fire("pointerup", 150, 100);
    seen.moved_px = (view.u - before) * view.scale;
    seen.after_drag = values();
    whole();
    const k = Math.floor(data.plants.u.length / 2);
    view.scale = 4;
    view.u = data.plants.u[k] - canvas.clientWidth / 8;
    view.v = data.plants.v[k] - canvas.clientHeight / 8;
    click(data.plants.u[k], data.plants.v[k]);
    seen.plant = values();
    seen.plant_number = k;
    box.querySelector('button[data-zoom="all"]').click();
    seen.whole = Math.abs(view.scale / start.scale - 1) < 1e-9;
    box.querySelector('input[data-layer="plants"]').click();
    const ring = data.plots[0].rings[0].slice(0, 4);
    const middle = [0, 1].map((axis) => ring.reduce((sum, at) => sum + at[axis], 0) / ring.length);
    click(...middle);
    seen.plot = values();
    seen.plot_name = data.plots[0].name;
    canvas.dispatchEvent(new KeyboardEvent("keydown", { key: "+", cancelable: true }));
    seen.key = view.scale / start.scale;
  } catch (error) {
    seen.error = String(error);
  }
  document.body.dataset.seen = encodeURIComponent(JSON.stringify(seen));
}, 300));
