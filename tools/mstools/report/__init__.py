"""The report on a replay: data, findings with causes, drawings."""
