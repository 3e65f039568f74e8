"""Floor plans as pictures, in SVG."""
