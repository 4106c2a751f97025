/**
 * Accepts video files that are dropped anywhere on the page.
 * @param {HTMLElement} hint shown while a file is dragged over the page
 * @param {(video: File) => void} onVideo
 */
export function listenForDrops(hint, onVideo) {
  addEventListener("dragover", (event) => {
    if (!event.dataTransfer?.types.includes("Files")) return;
    event.preventDefault();
    hint.hidden = false;
  });
  addEventListener("dragleave", (event) => {
    if (event.relatedTarget === null) hint.hidden = true;
  });
  addEventListener("drop", (event) => {
    event.preventDefault();
    hint.hidden = true;
    const [video] = event.dataTransfer?.files ?? [];
    if (video) onVideo(video);
  });
}
