"""Pages in the browser: throws to play with, the digital twin, a training, a recording."""
