"""Sensors, one plugin a file. `rimlight` registers them with Mitsuba for every variant (see `_registration`)."""
