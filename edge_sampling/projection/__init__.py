"""From world space to the film."""
