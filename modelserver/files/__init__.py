"""Files by path: bounded reading of regular files, and detection of what a file is."""
