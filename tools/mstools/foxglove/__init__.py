"""Drives for Foxglove: messages in its schemas, LCM messages as JSON, and a layout that shows them."""
