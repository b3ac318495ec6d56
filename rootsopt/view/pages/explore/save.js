// Hands the config to the browser as a file.
const link = document.createElement("a");
link.href = URL.createObjectURL(new Blob([file.text], { type: "application/yaml" }));
link.download = name;
document.body.append(link);
link.click();
link.remove();
URL.revokeObjectURL(link.href);
