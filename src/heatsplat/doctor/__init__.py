"""What is wrong with a recording, what it will cost, and what helps (``heatsplat.doctor.examination``)."""
