// The API key that was entered in this tab, and the dialog that asks for it.

const KEY = "specshield-key";
let asking = null;

export const key = () => sessionStorage.getItem(KEY);

/** Shows the dialog until a key is entered. All callers that wait for a key share it. */
export function askForKey(wrong) {
  asking ??= new Promise((done) => {
    const dialog = document.getElementById("key");
    const form = dialog.querySelector("form");
    dialog.querySelector(".wrong").textContent = wrong ? "The server does not know this key." : "";
    form.onsubmit = () => {
      sessionStorage.setItem(KEY, form.elements.key.value.trim());
      form.reset();
      asking = null;
      done();
    };
    // A browser closes the dialog when Escape is pressed twice; it opens again, as nothing can be shown without a key.
    dialog.onclose = () => asking && !dialog.open && dialog.showModal();
    dialog.showModal();
  });
  return asking;
}
