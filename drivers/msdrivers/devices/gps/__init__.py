"""Driver of satellite receivers: NovAtel OEM4 and successors, NMEA 0183."""
