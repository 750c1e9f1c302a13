"""From a photograph to poses: refinement, choice, one function for every caller."""
