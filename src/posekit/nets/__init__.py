"""The pose networks. They take and give tensors only, and use neither the renderer nor files."""
