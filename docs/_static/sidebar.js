// Groups of the sidebar fold. The group of the current page is open, on the front page the first one.
document.addEventListener("DOMContentLoaded", () => {
  const captions = [...document.querySelectorAll(".sidebar-tree .caption")];
  const current = document.querySelector(".sidebar-tree .current-page");
  for (const caption of captions) {
    const list = caption.nextElementSibling;
    const group = document.createElement("details"), title = document.createElement("summary");
    title.className = "caption";
    title.append(...caption.childNodes);
    caption.replaceWith(group);
    group.append(title, list);
    group.open = current ? list.contains(current) : caption === captions[0];
  }
  const scroll = document.querySelector(".sidebar-scroll");
  if (current && scroll) {
    const below = current.getBoundingClientRect().bottom - scroll.getBoundingClientRect().bottom;
    if (below > 0) scroll.scrollTop += below + 40;
  }
});
