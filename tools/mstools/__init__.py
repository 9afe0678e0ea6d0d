"""The `modelserver` command, one module a subcommand."""

import os

# Before numpy is imported: the threads of its linear algebra cost 0.1 s at each start and disturb the service's timing,
# and the matrices here, of some 30 rows, are too small for them. With more threads sums are also in another order.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
