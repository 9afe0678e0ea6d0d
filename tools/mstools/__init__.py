"""The `modelserver` command, one module a subcommand."""

import os

# Before numpy is imported: the threads of its linear algebra cost 0.1 s at each start, and the matrices here, of some
# 30 rows, are too small for them.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
