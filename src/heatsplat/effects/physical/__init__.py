"""One file for each physical effect; its ``EFFECT`` says all there is to say of it."""
