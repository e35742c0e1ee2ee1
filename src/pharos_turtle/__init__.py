"""The turtle simulator, an example with dependencies of its own: Pillow and tkinter."""
