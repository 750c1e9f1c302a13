"""Data sets and their files: BOP, LINEMOD, results; millimetres become metres here."""
