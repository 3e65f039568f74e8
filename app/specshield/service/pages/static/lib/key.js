// The key that this tab was given, and the dialog that asks for it.

const KEY = "specshield-key";
let asking = null;

export const key = () => sessionStorage.getItem(KEY);

/** Shows the dialog until a key is given; all who wait for one share it. */
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
    // A browser closes it for who presses Escape twice, whatever a page says; without a key nothing can be shown.
    dialog.onclose = () => asking && !dialog.open && dialog.showModal();
    dialog.showModal();
  });
  return asking;
}
