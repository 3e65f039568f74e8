// The line above every view: what there is to know of the server.

/** An empty text takes the line away. */
export function notice(text) {
  const place = document.getElementById("server");
  if (place.textContent !== text) place.textContent = text; // else it would be read aloud again
}
