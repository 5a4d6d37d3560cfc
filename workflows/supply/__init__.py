"""What the program is made of: the locks, what is installed, licences, and a bill of materials."""
