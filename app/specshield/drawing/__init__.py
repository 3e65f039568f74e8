"""Floor plans as pictures: the colours that all of them share, and SVG."""
