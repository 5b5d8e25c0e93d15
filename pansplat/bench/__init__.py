"""Speed against error."""
