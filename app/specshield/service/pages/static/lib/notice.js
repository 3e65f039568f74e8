// The line above every view, with news about the server.

/** Writes the line; an empty text removes it. */
export function notice(text) {
  const place = document.getElementById("server");
  if (place.textContent !== text) place.textContent = text; // else it would be read aloud again
}
