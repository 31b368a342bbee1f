"""Inverse rendering: fits of pose, material, light and shape, through the public interface of Mitsuba."""
