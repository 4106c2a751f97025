/** Dark or light colors: the system's choice, unless the visitor makes another one. */

const STORED = "lanestream-theme";

/** Applies the visitor's choice. */
export function restoreTheme() {
  const theme = localStorage.getItem(STORED);
  if (theme === "dark" || theme === "light") document.documentElement.dataset.theme = theme;
}

/** Switches to the other colors and remembers that. */
export function toggleTheme() {
  const isDark = matchMedia("(prefers-color-scheme: dark)").matches;
  const theme = (document.documentElement.dataset.theme ?? (isDark ? "dark" : "light")) === "dark" ? "light" : "dark";
  document.documentElement.dataset.theme = theme;
  localStorage.setItem(STORED, theme);
}
