"""The viewer: a drive as a whole, its picture in 3D, and the page in the browser."""
