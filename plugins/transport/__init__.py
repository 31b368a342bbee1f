"""Light along paths: the radiance that arrives along camera rays, and its interior derivative."""
