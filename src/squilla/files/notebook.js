// The picture of a cube in a notebook: a click, or the arrow keys, choose the spectrum beside it.
// `root` is the element around picture and plot, `data` what notebook.py keeps of the cube.
(root, data) => {
  const bytes = Uint8Array.from(atob(data.share), (letter) => letter.charCodeAt(0));
  const { wavelength, rows, columns, largest } = data, bands = wavelength.length;
  const picture = root.querySelector(".picture"), plot = root.querySelector(".plot");
  const name = "http://www.w3.org/2000/svg", width = 420, height = plot.clientHeight || 320;
  const draw = (parent, kind, facts, text) => {
    const item = document.createElementNS(name, kind);
    for (const key in facts) item.setAttribute(key, facts[key]);
    if (text !== undefined) item.textContent = text;
    return parent.appendChild(item);
  };
  const size = Math.max(picture.viewBox.baseVal.width, picture.viewBox.baseVal.height) / 60;
  const mark = draw(picture, "circle", { r: size, fill: "none", stroke: "white", "stroke-width": size / 3 });
  let row = rows.length >> 1, column = columns.length >> 1;
  const nearest = (places, place) => places.reduce(
    (best, each, at) => Math.abs(each - place) < Math.abs(places[best] - place) ? at : best, 0);
  const show = () => {
    mark.setAttribute("cx", columns[column] + 0.5);
    mark.setAttribute("cy", rows[row] + 0.5);
    const at = row * columns.length + column, top = largest[at];
    const values = Array.from(bytes.subarray(at * bands, (at + 1) * bands), (value) => value / 255);
    const [first, last] = [wavelength[0], wavelength[bands - 1]];
    const x = (value) => 44 + (width - 56) * (value - first) / (last - first || 1);
    const y = (share) => height - 34 - (height - 50) * share;
    plot.replaceChildren();
    const line = { stroke: "currentColor", "stroke-width": 0.5, opacity: 0.5 };
    draw(plot, "line", { x1: 44, x2: width - 12, y1: y(0), y2: y(0), ...line });
    draw(plot, "line", { x1: 44, x2: 44, y1: y(0), y2: y(1), ...line });
    const text = { fill: "currentColor", "font-size": 11 };
    for (let tick = Math.ceil(first / 50) * 50; tick <= last; tick += 50)
      draw(plot, "text", { x: x(tick), y: height - 18, "text-anchor": "middle", ...text }, tick);
    draw(plot, "text", { x: (width + 32) / 2, y: height - 3, "text-anchor": "middle", ...text }, "nm");
    draw(plot, "text", { x: 40, y: y(1) + 4, "text-anchor": "end", ...text }, top.toPrecision(3));
    draw(plot, "text", { x: 40, y: y(0) + 4, "text-anchor": "end", ...text }, 0);
    draw(plot, "text", { x: width - 12, y: 11, "text-anchor": "end", ...text },
      `row ${rows[row]}, column ${columns[column]}`);
    const path = values.map((value, band) => `${band ? "L" : "M"}${x(wavelength[band])},${y(value)}`).join("");
    draw(plot, "path", { d: path, fill: "none", stroke: "#0f8b8d", "stroke-width": 1.8 });
  };
  const choose = (event) => {
    const box = picture.getBoundingClientRect(), view = picture.viewBox.baseVal;
    column = nearest(columns, (event.clientX - box.left) / box.width * view.width - 0.5);
    row = nearest(rows, (event.clientY - box.top) / box.height * view.height - 0.5);
    show();
  };
  picture.addEventListener("pointerdown", choose);
  picture.addEventListener("pointermove", (event) => event.buttons && choose(event));
  picture.addEventListener("keydown", (event) => {
    const step = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] }[event.key];
    if (!step) return;
    event.preventDefault();
    event.stopPropagation();
    row = Math.min(Math.max(row + step[0], 0), rows.length - 1);
    column = Math.min(Math.max(column + step[1], 0), columns.length - 1);
    show();
  });
  show();
}
