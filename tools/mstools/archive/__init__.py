"""Archives: many logs replayed on a cluster, their results as Parquet tables, and reports over all of them."""
