// Elements and small charts. All texts of the game become text nodes, never markup.

export const $ = (id) => document.getElementById(id);

export function make(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}

// A number in four digits, as the game writes it.
export function show(value) {
  if (typeof value !== "number") return String(value ?? "");
  if (Number.isInteger(value)) return String(value).replace("-", "−");
  const text = Math.abs(value) >= 10000 ? String(Math.round(value)) : String(+value.toPrecision(4));
  return text.replace("-", "−");
}

export const signed = (value) => (value > 0 ? `+${show(value)}` : show(value));

// A function that puts values on the height of a chart, with the ends of its axis.
export function scale(values) {
  const low = Math.min(...values), high = Math.max(...values);
  const place = (value) => 38 - 36 * (high > low ? (value - low) / (high - low) : 0.5);
  return Object.assign(place, { low, high });
}

// A chart of polygons and polylines: [tag, points, class].
export function draw(label, ...parts) {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  const set = (element, values) => Object.entries(values).forEach((pair) => element.setAttribute(...pair));
  set(svg, { viewBox: "0 0 100 40", preserveAspectRatio: "none", role: "img", "aria-label": label });
  for (const [tag, points, kind = ""] of parts) {
    const element = document.createElementNS(svg.namespaceURI, tag);
    set(element, { points: points.join(" "), class: kind });
    svg.append(element);
  }
  return svg;
}

export const across = (values, y) => values.map((value, i) => [100 * i / Math.max(1, values.length - 1), y(value)]);

export function spark(label, values) {
  return draw(`${label}: the last ${values.length} values`, ["polyline", across(values, scale(values))]);
}

export function fanChart(label, [below, middle, above], y, single) {
  const band = ["polygon", [...across(below, y), ...across(above, y).reverse()]];
  const line = ["polyline", across(middle, y)];
  return single ? draw(label, line) : draw(label, band, line);
}
