"""The boundary terms of a derivative: what edges that move do to an image."""
