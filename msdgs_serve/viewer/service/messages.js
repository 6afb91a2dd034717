// What the page says when something that was asked for isn't there.

const LONGEST_NAME = 60; // characters

export const NO_SCENES = "No scenes. Files that are added to the service’s folder appear here.";

export function noScene(name) {
  if (!name.trim()) return "The link doesn’t say which scene. Choose one from the list.";
  const letters = [...name];
  const shown = letters.length > LONGEST_NAME ? `${letters.slice(0, LONGEST_NAME).join("")}…` : name;
  return `There is no scene “${shown}”. It may have been renamed or deleted. Choose one from the list.`;
}

export const sceneGone = (name) => `${name} is gone. This is its last frame; other scenes are in the list.`;
