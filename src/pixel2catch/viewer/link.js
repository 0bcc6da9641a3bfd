// The connection of a page of our own to the program that serves it.

let link = null;

export const part = (id) => document.getElementById(id);

export function ask(request) {
  if (link?.readyState === WebSocket.OPEN) link.send(JSON.stringify(request));
}

// Images go to `show` and all else to `hear`; `lose` is called when the connection ends, before the next try.
export function connect(path, show, hear, lose) {
  link = new WebSocket(`${location.origin.replace(/^http/, "ws")}${path}/link`);
  link.binaryType = "blob";
  link.onmessage = ({ data }) => (data instanceof Blob ? show(data) : hear(JSON.parse(data)));
  link.onclose = () => {
    lose();
    setTimeout(() => connect(path, show, hear, lose), 500);
  };
}
