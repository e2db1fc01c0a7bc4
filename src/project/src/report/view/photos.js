// The photos in whose frame a clicked place lies, each with the place in the middle.
(function () {
  "use strict";
  const box = document.getElementById("field-map");
  const shelf = box && box.querySelector(".photos");
  if (!shelf) return;
  const SIDE_PX = 160;
  const MOST = 24;
  let asked = 0;
  function figure(of) {
    const [columns, rows] = of.size_px;
    const frame = document.createElement("figure");
    const pane = document.createElement("div");
    pane.className = "window";
    const picture = document.createElement("img");
    picture.alt = "Part of " + of.image;
    picture.src = "photos/" + of.number + ".jpg?u=" + of.u_px + "&v=" + of.v_px + "&side=" + SIDE_PX;
    // At the edge of a photo the part is smaller than the pane.
    const left = Math.round(Math.min(Math.max(of.u_px - SIDE_PX / 2, 0), columns));
    const top = Math.round(Math.min(Math.max(of.v_px - SIDE_PX / 2, 0), rows));
    picture.addEventListener("load", () => {
      const share = (px) => 100 * px / SIDE_PX + "%";
      picture.style.width = share(picture.naturalWidth);
      picture.style.left = share(left - (of.u_px + 0.5 - SIDE_PX / 2));
      picture.style.top = share(top - (of.v_px + 0.5 - SIDE_PX / 2));
    });
    pane.append(picture);
    const text = document.createElement("figcaption");
    text.textContent = of.image + ": column " + of.u_px.toFixed(1) + ", row " + of.v_px.toFixed(1) + ", " + of.view_angle_deg.toFixed(0) +
      "° from above" + (of.is_source ? "; the map shows this one" : "");
    frame.append(pane, text);
    return frame;
  }
  box.addEventListener("field-click", async (event) => {
    const { u, v } = event.detail;
    asked += 1;
    const mine = asked;
    const answer = await fetch("photos?u=" + u + "&v=" + v);
    const found = answer.ok ? await answer.json() : [];
    if (mine === asked) shelf.replaceChildren(...found.slice(0, MOST).map(figure));
  });
})();
