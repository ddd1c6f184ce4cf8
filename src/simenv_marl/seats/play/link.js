// The connection to the server. It connects again when it is lost.

export const page = {
  key: new URLSearchParams(location.search).get("key") || "",
  path: location.pathname,
  seat: null, // the seat of the key; "" for the facilitator; null for all others
  state: null, // the latest snapshot of the game
  fan: null, // the latest futures
  rule: null, // the totals of the rule's game, at the end
  people: { taken: {}, opened: [], spectators: 0, open: false },
  busy: false, // the simulation computes
  lost: false, // there is no connection
  stranger: "", // why this page may see nothing
  arrived: 0, // when the latest snapshot has arrived
};

let socket;

export function connect(changed) {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  socket = new WebSocket(`${scheme}://${location.host}/ws`);
  socket.onopen = () => {
    page.lost = false;
    if (page.key) send({ do: "take" });
    changed("open");
  };
  socket.onclose = () => {
    page.lost = true;
    changed("lost");
    setTimeout(() => connect(changed), 1000);
  };
  socket.onmessage = ({ data }) => {
    const message = JSON.parse(data);
    if (message.type === "state") [page.state, page.arrived, page.busy] = [message, Date.now(), false];
    if (message.type === "fan") page.fan = message;
    if (message.type === "rule") page.rule = message;
    if (message.type === "people") page.people = message;
    if (message.type === "busy") page.busy = message.on;
    if (message.type === "you") page.seat = message.seat;
    if (message.type === "link") location.assign(message.path);
    if (message.type === "error") {
      page.busy = false;
      if (message.stranger) page.stranger = message.text;
    }
    changed(message.type, message);
  };
}

export function send(message) {
  if (socket.readyState !== 1) return false;
  socket.send(JSON.stringify(page.key ? { ...message, key: page.key } : message));
  return true;
}

// Ask the game for a change, once: until it answers, the page says that the simulation computes.
export function move(message) {
  if (page.busy || page.lost || !page.state) return false;
  page.busy = send({ moment: page.state.moment, ...message });
  return page.busy;
}
