"""What is not the subject: command lines, safe readers, run folders, pictures."""
