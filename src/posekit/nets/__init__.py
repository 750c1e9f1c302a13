"""The pose networks. They know tensors only: neither the renderer nor files of pictures."""
