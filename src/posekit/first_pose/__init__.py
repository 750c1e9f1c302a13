"""First poses from a box: templates, evidence, MV-Net, local features."""
