// Light and dark: as the system is, until somebody chooses.

const root = document.documentElement;

/**
 * A colour of the present theme.
 * @param {string} name of a variable in page.css, without the dashes
 * @returns {string}
 */
export function colour(name) {
  return getComputedStyle(root).getPropertyValue(`--${name}`).trim();
}

/**
 * Make the switch work.
 * @param {HTMLButtonElement} button
 * @param {() => void} changed called when the colours are different
 */
export function startTheme(button, changed) {
  const set = (theme) => {
    root.dataset.theme = theme;
    button.textContent = theme === "dark" ? "Light" : "Dark";
    button.setAttribute("aria-label", theme === "dark" ? "Use light colours" : "Use dark colours");
    changed();
  };
  button.addEventListener("click", () => {
    const theme = root.dataset.theme === "dark" ? "light" : "dark";
    try {
      localStorage.setItem("theme", theme);
    } catch {
      // It holds until the page is closed.
    }
    set(theme);
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", (event) => {
    let chosen = null;
    try {
      chosen = localStorage.getItem("theme");
    } catch {
      // Nothing was chosen.
    }
    if (chosen === null) set(event.matches ? "dark" : "light");
  });
  set(root.dataset.theme);
}
