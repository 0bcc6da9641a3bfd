// The connection of an own page to the program that serves it.

let link = null;

export const part = (id) => document.getElementById(id);

export function send(request) {
  if (link?.readyState === WebSocket.OPEN) link.send(JSON.stringify(request));
}

// Images go to `show`, states to `receive`; `lose` is called when the connection ends, before the next try.
export function connect(show, receive, lose) {
  link = new WebSocket(`${location.origin.replace(/^http/, "ws")}/link`);
  link.binaryType = "blob";
  link.onmessage = ({ data }) => (data instanceof Blob ? show(data) : receive(JSON.parse(data)));
  link.onclose = () => {
    lose();
    setTimeout(() => connect(show, receive, lose), 500);
  };
}
