// What leaves the page: files made in the browser itself.

/** Let the browser save a blob under a name. */
export function save(name, blob) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}

/** Save a picture as it is shown, pixel for pixel, without marks; small ones are enlarged. */
export function savePicture(name, image) {
  const times = Math.max(1, Math.floor(1024 / Math.max(image.width, image.height)));
  const canvas = document.createElement("canvas");
  canvas.width = image.width * times;
  canvas.height = image.height * times;
  const pen = canvas.getContext("2d");
  pen.imageSmoothingEnabled = false;
  pen.drawImage(image, 0, 0, canvas.width, canvas.height);
  canvas.toBlob((blob) => save(name, blob));
}

/** Save the plot at twice its size on the screen. */
export function savePlot(name, plot) {
  const canvas = document.createElement("canvas");
  canvas.width = plot.width * 2;
  canvas.height = plot.height * 2;
  plot.draw(canvas.getContext("2d"), 2);
  canvas.toBlob((blob) => save(name, blob));
}
