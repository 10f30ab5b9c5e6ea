// Enlarged pictures. The slider moves the border between the photograph (left) and the picture (right).
const dialog = document.querySelector('dialog'), below = dialog.querySelector('.below'), above = dialog.querySelector('.above');
const slider = dialog.querySelector('input'), title = dialog.querySelector('.bar b');
let pictures = [], current = 0;
function wipe() {
  const box = above.getBoundingClientRect(), fit = Math.min(box.width / above.naturalWidth, box.height / above.naturalHeight);
  const left = (box.width - above.naturalWidth * fit) / 2;
  above.style.clipPath = `inset(0 0 0 ${left + above.naturalWidth * fit * slider.value / 100}px)`;
}
function show(index) {
  current = (index + pictures.length) % pictures.length;
  above.src = pictures[current].src; above.alt = title.textContent = pictures[current].alt; below.src = pictures[0].src;
  above.decode().then(wipe, wipe);
}
document.querySelectorAll('.zoom').forEach(button => button.addEventListener('click', () => {
  pictures = [...button.closest('article').querySelectorAll('.zoom img')];
  slider.value = 0; dialog.showModal(); show(pictures.indexOf(button.firstElementChild));
}));
dialog.addEventListener('click', event => {
  if (event.target.dataset.step) show(current + +event.target.dataset.step);
  else if (event.target.closest('.stage, [data-close]')) dialog.close();
});
dialog.addEventListener('keydown', event => {
  if (event.target !== slider && event.key === 'ArrowRight') show(current + 1);
  if (event.target !== slider && event.key === 'ArrowLeft') show(current - 1);
});
slider.addEventListener('input', wipe);
window.addEventListener('resize', wipe);
